"""The engine once more, naively: NumPy, dense matrices, one run, written from the equations.

Slow and plain on purpose. Nothing here comes from the filter, mechanisation or error model that
it is compared with.
Vectors and matrices are arrays, attitude is a matrix C_b^n.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

DEG = np.pi / 180


def skew(v):
    """The matrix of v x."""
    x, y, z = v
    return np.array([[0 * x, -z, y], [z, 0 * x, -x], [-y, x, 0 * x]])


def exp(v):
    """Rotation matrix of a rotation vector."""
    return Rotation.from_rotvec(v).as_matrix()


def log(c):
    """Rotation vector of a rotation matrix."""
    return Rotation.from_matrix(c).as_rotvec()


def quaternion(c):
    """Scalar first."""
    return Rotation.from_matrix(c).as_quat(scalar_first=True)


def of_quaternion(q):
    """Rotation matrix of a quaternion, scalar first."""
    return Rotation.from_quat(np.asarray(q, dtype=float), scalar_first=True).as_matrix()


def euler_matrix(pitch, roll, yaw):
    """C_b^n = Rz(yaw) Rx(pitch) Ry(roll); takes complex angles too."""
    sp, cp, sr, cr, sy, cy = (f(a) for a in (pitch, roll, yaw) for f in (np.sin, np.cos))
    one, zero = 1 + 0 * pitch, 0 * pitch
    rz = np.array([[cy, -sy, zero], [sy, cy, zero], [zero, zero, one]])
    rx = np.array([[one, zero, zero], [zero, cp, -sp], [zero, sp, cp]])
    ry = np.array([[cr, zero, sr], [zero, one, zero], [-sr, zero, cr]])
    return rz @ rx @ ry


class Planet(NamedTuple):
    """An ellipsoid with Somigliana's gravity, or a sphere with constant gravity."""

    rate: float
    a: float
    b: float
    gravity: float | None

    def radii(self, latitude):
        """Meridian and prime vertical radius of curvature, m."""
        along = (self.a * np.cos(latitude)) ** 2 + (self.b * np.sin(latitude)) ** 2
        return self.a**2 * self.b**2 / along**1.5, self.a**2 / np.sqrt(along)

    def g(self, latitude):
        """Gravity at height zero, m/s^2."""
        if self.gravity is not None:
            return self.gravity
        c, s = self.a * np.cos(latitude), self.b * np.sin(latitude)
        top = c * np.cos(latitude) * 9.7803253359 + s * np.sin(latitude) * 9.8321849378595
        return top / np.hypot(c, s)

    def rates(self, latitude, velocity):
        """w_ie and w_en in ENU, rad/s."""
        ve, vn = velocity
        rm, rn = self.radii(latitude)
        w_ie = self.rate * np.array([0.0, np.cos(latitude), np.sin(latitude)])
        return w_ie, np.array([-vn / rm, ve / rn, ve * np.tan(latitude) / rn])


WGS84 = Planet(7.292115e-5, 6378137.0, 6356752.314245, None)
PAPER = Planet(15.041067 * DEG / 3600, 6378137.0, 6378137.0, 9.8)
SECOND_PAPER = PAPER._replace(a=6378165.0, b=6378165.0)
"""The radius that the gains printed in [P2] fit to every digit."""


class Swing(NamedTuple):
    """Euler angles (pitch, roll, yaw): center + amplitude sin(2 pi t / period + phase)."""

    center: np.ndarray
    amplitude: np.ndarray
    period: np.ndarray
    phase: np.ndarray

    def matrix(self, t):
        """C_b^n at time t, which may be complex."""
        return euler_matrix(
            *(self.center + self.amplitude * np.sin(2 * np.pi * t / self.period + self.phase))
        )

    def rate_and_force(self, t, planet, latitude):
        """w_ib^b from C' = C (w_nb^b x) by a complex step, and f^b, of a base that stays."""
        step = 1e-30
        c = self.matrix(t + 0j).real
        turning = c.T @ self.matrix(t + 1j * step).imag / step
        w_nb = np.array([turning[2, 1], turning[0, 2], turning[1, 0]])
        w_ie, _ = planet.rates(latitude, (0.0, 0.0))
        return w_nb + c.T @ w_ie, c.T @ np.array([0.0, 0.0, planet.g(latitude)])


def compensate(increments):
    """Rotation vectors and velocity increments with the previous sample's coning and sculling."""
    theta, dv = increments[:, :3], increments[:, 3:]
    theta0 = np.concatenate([theta[:1], theta[:-1]])
    dv0 = np.concatenate([dv[:1], dv[:-1]])
    rotation = np.cross(theta, dv)
    sculling = (np.cross(theta0, dv) + np.cross(dv0, theta)) / 12
    return (
        theta + np.cross(theta0, theta) / 12,
        dv + rotation / 2 + np.cross(theta, rotation) / 6 + sculling,
    )


def error_matrix(velocity, f, planet, latitude):
    """A of [P1] eq. (3), dense: dVE dVN phiE phiN phiU, VU = 0."""
    ve, vn = velocity
    rm, rn = planet.radii(latitude)
    _, wn, wu = planet.rates(latitude, velocity)[0]
    t = np.tan(latitude)
    return np.array(
        [
            [vn * t / rn, 2 * wu + ve * t / rn, 0, -f[2], f[1]],
            [-2 * (wu + ve * t / rn), 0, f[2], 0, -f[0]],
            [0, -1 / rm, 0, wu + ve * t / rn, -(wn + ve / rn)],
            [1 / rn, 0, -(wu + ve * t / rn), 0, -vn / rm],
            [t / rn, 0, wn + ve / rn, vn / rm, 0],
        ]
    )


def error_matrix_10(velocity, f, planet, latitude, c):
    """The same with accelerometer biases x, y and gyro biases x, y, z in the body frame."""
    a = np.zeros((10, 10))
    a[:5, :5] = error_matrix(velocity, f, planet, latitude)
    a[:2, 5:7] = c[:2, :2]
    a[2:5, 7:] = -c
    return a


class Filter(NamedTuple):
    """Numbers and choices of a closed loop; p0 and q in the order of its states."""

    p0: np.ndarray
    q: np.ndarray
    r: float
    every: int = 1
    gain: float = 1.0
    resets: tuple[int, ...] = ()
    kind: str = "full"
    factor: float = 10.0
    force: str = "measured"
    position: str = "fixed"
    turn: str = "carried"
    turn_factor: float = 10.0
    restarts: bool = False
    at_feedback: bool = False


class Clock:
    """When a filter feeds back and resets, told sample after sample from the ``first`` one on.

    Feedback comes ``every`` so many samples of a run, or of what follows a reset that ``restarts``
    the clock; scheduled resets come in time, or wait for the feedback after that.
    """

    def __init__(self, filt, first=1):
        """Begin before the ``first`` sample, which is the first of an interval."""
        self.filt, self.began, self.waits = filt, first - 1, False

    def look(self, k, called=False):
        """Whether feedback, and whether a reset is due after sample k, which may call for one."""
        feedback = (k - self.began) % self.filt.every == 0
        self.waits = self.waits or k in self.filt.resets
        scheduled = self.waits and (feedback or not self.filt.at_feedback)
        self.waits, reset = self.waits and not scheduled, scheduled or called
        if reset and self.filt.restarts:
            self.began = k
        return feedback, reset


class Innovation(NamedTuple):
    """What a watcher sees of sample k: r and its covariance s, Earth, latitude, attitude before."""

    k: int
    r: np.ndarray
    s: np.ndarray
    earth: Planet
    latitude: float
    c: np.ndarray


class Unwatched:
    """Watches a filter and does nothing; `naive_triggers` do."""

    def look(self, seen, x, p):
        """Whether P is to be reset after an update that gave x and P."""
        return False

    def feed(self, phi):
        """Take an attitude correction in that is fed back."""

    def begin(self, k, p):
        """Take in that sample k ended with a reset that left P."""

    def turn(self, x, p):
        """Take in that the record is turned, with x and P."""


def wound_back(c, increments, dt, planet, latitude):
    """C_b^n before some increments that have led to c."""
    w_ie, _ = planet.rates(latitude, (0.0, 0.0))
    theta, _ = compensate(increments)
    for turn in Rotation.from_rotvec(theta).as_matrix()[::-1]:
        c = exp(w_ie * dt) @ c @ turn.T
    return c


class History(NamedTuple):
    """After every sample: the solution, the estimate, and what follows from it.

    ``bias`` has been fed back, ``corrected`` is the attitude with all that is estimated taken out,
    ``nis`` the normalised innovation squared.
    """

    c: np.ndarray
    v: np.ndarray
    latitude: np.ndarray
    longitude: np.ndarray
    x: np.ndarray
    p: np.ndarray
    bias: np.ndarray
    corrected: np.ndarray
    nis: np.ndarray


def mechanise(c, v, turn, dv, planet, latitude, dt, control=0.0):
    """C, V after one sample and the mean f^n over it, from the sample's rotation and velocity.

    The platform is turned by ``control`` (3 rates in n) beside w_in.
    """
    w_ie, w_en = planet.rates(latitude, v)
    w = w_ie + w_en + control
    f = (c @ dv - np.cross(w * dt / 2, c @ dv)) / dt
    coriolis = np.cross(2 * w_ie + w_en, [*v, 0.0])
    return exp(-w * dt) @ c @ turn, v + dt * (f - coriolis)[:2], f


class Update(NamedTuple):
    """One update of a run over a record: its number from 1, the sample, and the way it is read."""

    k: int
    turn: np.ndarray
    dv: np.ndarray
    way: int
    turns: bool


def updates(increments, stored=None, count=None):
    """Forward and backward passes over ``stored`` samples, ``count`` updates, [P2] section 2.3.

    Backward, samples come last to first; the body turns back from where a sample ended, and the
    specific force is seen from there. ``turns`` marks the first update of every pass but the first.
    """
    stored = stored or len(increments)
    theta, dvs = compensate(increments[:stored])
    turns = Rotation.from_rotvec(theta).as_matrix()
    for n in range(count or stored):
        number, place = divmod(n, stored)
        if number % 2 == 0:
            yield Update(n + 1, turns[place], dvs[place], 1, number > 0 and place == 0)
        else:
            back = turns[stored - 1 - place].T
            yield Update(n + 1, back, back @ dvs[stored - 1 - place], -1, place == 0)


def update(x, p, h, z, r):
    """The joint Kalman update with H, R = r I."""
    gain = p @ h.T @ np.linalg.inv(h @ p @ h.T + r * np.eye(len(h)))
    return x + gain @ (z - h @ x), (np.eye(len(x)) - gain @ h) @ p


def reset(p, filt, heading=(4,)):
    """P after a reset; that of yaw touches the states of heading."""
    p0 = np.diag(filt.p0)
    if filt.kind == "full":
        return p0
    if filt.kind == "scale":
        return filt.factor * p
    out = p.copy()
    for i in heading:
        out[i, :] = out[:, i] = 0.0
    for i in heading:
        out[i, i] = p0[i, i]
    return out


class Sample(NamedTuple):
    """What a filter's model is made of at a sample: attitude and velocity before it, mean f^n."""

    earth: Planet
    latitude: float
    dt: float
    c: np.ndarray
    v: np.ndarray
    f: np.ndarray


class Model(NamedTuple):
    """An error model: of x, the first two errors of velocity, the last ``biases`` of the sensors.

    Attributes:
        signs: of the states under time reversal.
        heading: numbers of the states that a reset of yaw touches.
        start: x before the first sample.
        predict: (x, p, `Sample`) -> x, p after it, without Q.
        feed: (share of x, c, v) -> c, v corrected; v with the vertical velocity.
        kept: numbers of the states that are not fed back.
        corrected: (x, c) -> attitude with all that is estimated taken out.
        measured: (2, n) what of x is the level velocity of the solution; None: the first two.
        biases: 5 with biases of two accelerometers and three gyros, else 0.
    """

    signs: np.ndarray
    heading: tuple[int, ...]
    start: np.ndarray
    predict: Callable
    feed: Callable
    kept: tuple[int, ...]
    corrected: Callable
    measured: np.ndarray | None = None
    biases: int = 0


def linear(a, x, p, dt):
    """X and p after dt of x' = A x."""
    phi = np.eye(len(x)) + a * dt
    return phi @ x, phi @ p @ phi.T


def _predict_five(x, p, at):
    return linear(error_matrix(at.v, at.f, at.earth, at.latitude), x, p, at.dt)


def _predict_ten(x, p, at):
    return linear(error_matrix_10(at.v, at.f, at.earth, at.latitude, at.c), x, p, at.dt)


FIVE, TEN = (
    Model(
        np.array([-1.0] * 2 + [1.0] * 3 + ([1.0] * 2 + [-1.0] * 3)[:biases]),
        (4,),
        np.zeros(5 + biases),
        predict,
        lambda fed, c, v: (exp(fed[2:5]) @ c, v - np.array([*fed[:2], 0.0])),
        (),
        lambda x, c: exp(x[2:5]) @ c,
        biases=biases,
    )
    for biases, predict in ((0, _predict_five), (5, _predict_ten))
)
"""The filters of [P1], without and with biases."""


def closed_loop(
    model, increments, dt, planet, filt, start, *, stored=None, count=None, watcher=None, first=1
):
    """Mechanise, predict, update, feed back and reset, sample after sample, over a stored record.

    The run starts with an attitude, a velocity and a latitude, before the update number ``first``.
    A ``watcher`` of `naive_triggers` resets P in addition to the schedule.
    """
    watcher, clock = watcher or Unwatched(), Clock(filt, first)
    c, v, latitude = start
    n, flip, biases = len(filt.p0), np.diag(model.signs), slice(len(filt.p0) - model.biases, None)
    x, p, bias, v = model.start, np.diag(filt.p0), np.zeros(model.biases), np.array([*v, 0.0])
    h = np.eye(n)[:2] if model.measured is None else model.measured
    longitude, fixed, history = 0.0, latitude, []
    for k, turn, dv, way, turns in updates(increments, stored, count):
        if k < first:
            continue
        if turns:
            p = {"carried": p, "inflated": filt.turn_factor * p}.get(filt.turn, np.diag(filt.p0))
            v, x, p, bias = -v, flip @ x, flip @ p @ flip.T, model.signs[biases] * bias
            watcher.turn(x, p)
        earth = planet._replace(rate=way * planet.rate)
        at = latitude if filt.position == "integrated" else fixed
        if model.biases:
            turn = turn @ exp(-bias[2:] * dt)
            dv = dv - np.array([*bias[:2], 0.0]) * dt
        w_ie, w_en = earth.rates(at, v[:2])
        upward = np.cross(2 * w_ie + w_en, [*v[:2], 0.0])[2]
        before = Sample(earth, at, dt, c, v[:2], None)
        c, level, f = mechanise(c, v[:2], turn, dv, earth, at, dt)
        v = np.array([*level, v[2] + dt * (f[2] - planet.g(at) - upward)])
        if filt.position == "integrated":
            latitude, longitude = travel(latitude, longitude, v, planet, dt)
        before = before._replace(f=f)
        if filt.force == "gravity":  # linearised about a base at rest
            before = before._replace(v=np.zeros(2), f=np.array([0.0, 0.0, planet.g(at)]))
        x, p = model.predict(x, p, before)
        p = p + np.diag(filt.q)
        seen = Innovation(k, v[:2] - h @ x, h @ p @ h.T + filt.r * np.eye(2), earth, at, before.c)
        nis = seen.r @ np.linalg.solve(seen.s, seen.r)
        x, p = update(x, p, h, v[:2], filt.r)
        feedback, due = clock.look(k, watcher.look(seen, x, p))
        share = 1.0 if due else filt.gain if feedback else 0.0
        fed = share * x
        fed[list(model.kept)] = 0.0
        watcher.feed(fed[2:5])
        if share:
            c, v = model.feed(fed, c, v)
            x, bias = x - fed, bias + fed[biases]
        if due:
            p = reset(p, filt, model.heading)
            watcher.begin(k, p)
        history.append((c, v, latitude, longitude, x, p, bias, model.corrected(x, c), nis))
    return History(*(np.array(column) for column in zip(*history, strict=True)))


def travel(latitude, longitude, v, planet, dt):
    """Latitude and longitude after the velocity of a sample."""
    rm, rn = planet.radii(latitude)
    return latitude + v[1] / rm * dt, longitude + v[0] / (rn * np.cos(latitude)) * dt


def level_gains(sigma, planet):
    """K1, K2, K3 of [P2] eq. (18) with xi = sqrt(1/2), on a sphere."""
    return 3 * sigma, 4 * sigma**2 * planet.a / planet.gravity - 1, 2 * sigma**3 / planet.gravity


def azimuth_gains(sigma, planet):
    """K1 to K4 of [P2] eq. (23), on a sphere."""
    g = planet.gravity
    return 2 * sigma, 4 * sigma**2 * planet.a / g - 1, 4 * sigma**4 / g, 2 * sigma


class Loops(NamedTuple):
    """Compass loops: K1, K2, K3 of levelling; from which sample on the azimuth loop has K1 to K4.

    ``smoothing`` is the share of a sample in each of the two stages of the low-passed specific
    force, ``turn`` a turn rule.
    """

    level: tuple[float, float, float]
    azimuth: tuple[tuple[float, tuple[float, float, float, float]], ...] = ()
    smoothing: float = 1.0
    turn: str = "velocity"
    position: str = "fixed"


class CompassHistory(NamedTuple):
    """After every update: attitude, velocity, place, levelling integrals, azimuth rate, force."""

    c: np.ndarray
    v: np.ndarray
    latitude: np.ndarray
    longitude: np.ndarray
    integral: np.ndarray
    rate: np.ndarray
    force: np.ndarray


def compass_loop(increments, dt, planet, *, latitude, c, v, loops, stored=None, count=None):
    """The loops of [P2] section 2.1 around the mechanisation, over a stored record.

    The Earth turns back in a backward pass, so that K3 / omega_N changes its sign there.
    """
    integral, rate, force = np.zeros(2), 0.0, np.zeros((2, 2))  # stages x (east, north)
    longitude, fixed, history = 0.0, latitude, []
    for k, turn, dv, way, turns in updates(increments, stored, count):
        if turns:
            c, v, integral, rate, force = turned_platform(
                c, v, integral, rate, force, planet.g(fixed), loops.turn
            )
        earth = planet._replace(rate=way * planet.rate)
        at = latitude if loops.position == "integrated" else fixed
        rm, rn = planet.radii(at)
        begun = [gains for begin, gains in loops.azimuth if k > begin]
        k1, k2, k3, k4 = begun[-1] if begun else (*loops.level[:2], 0.0, 0.0)
        level1, level2, level3 = loops.level
        held = 0.0 if begun else integral[1]
        control = np.array([-k2 * v[1] / rm - held, level2 * v[0] / rn + integral[0], rate])
        before = v
        c, v, f = mechanise(c, v, turn, dv, earth, at, dt, control)
        if loops.position == "integrated":
            latitude, longitude = travel(latitude, longitude, v, planet, dt)
        v = v - dt * np.array([level1, k1]) * before
        integral = integral + level3 * dt * before * [1.0, 0.0 if begun else 1.0]
        omega_n = earth.rates(at, before)[0][1]
        rate = rate + dt * (k3 / omega_n * before[1] - k4 * rate)
        once = force[0] + loops.smoothing * (f[:2] - force[0])
        force = np.array([once, force[1] + loops.smoothing * (once - force[1])])
        history.append((c, v, latitude, longitude, integral, rate, force))
    return CompassHistory(*(np.array(column) for column in zip(*history, strict=True)))


def turned_platform(c, v, integral, rate, force, g, rule):
    """The loops' state where the record is turned.

    A specific force (f_E, f_N) that stands for tilts -f_E / g about N and f_N / g about E is
    turned into its opposite by twice these angles.
    """
    if rule == "reflect":
        tilt = np.array([force[1, 1], -force[1, 0], 0.0]) / g
        return exp(2 * tilt) @ c, -v, -integral, rate, -force
    rate = -rate if rule == "velocity_and_rate" else rate
    return c, v if rule == "keep" else -v, -integral, rate, force


class Judged(NamedTuple):
    """What a run is judged by, from its curves."""

    outside_until: np.ndarray
    mean: np.ndarray
    std: np.ndarray
    above_share: np.ndarray
    nees: float
    nis_u: float


def judge(times, values, sigma_u, *, p, floor, bands, window, after):
    """Metrics from whole curves.

    Args:
        times: (N,) record times.
        values: (N, 6) phi e, n, u, pitch, roll, yaw, rad.
        sigma_u: (N,) 1 sigma of phi_u.
        p: (3, 3) covariance of phi at the end.
        floor: of phi_u.
        bands: half-widths.
        window: start and end.
        after: times after which the three shares of P above the squared error count.
    """
    error = values[:, 2] - floor
    outside = []
    for errors in (error, values[:, 2]):
        bad = [[t for t, e in zip(times, errors, strict=True) if not abs(e) <= b] for b in bands]
        outside.append([late[-1] if late else 0.0 for late in bad])
    taken = values[(times > window[0]) & (times <= window[1])]
    # Six columns are angles: average about the first as unwrapped curves.
    unwrapped = np.unwrap(taken, axis=0)
    mean = unwrapped.mean(axis=0)
    shares = [
        np.mean((sigma_u**2 > e**2)[times > start])
        for e, start in zip((values[:, 2], error, values[:, 2]), after, strict=True)
    ]
    phi = values[-1, :3]
    return Judged(
        np.array(outside),
        np.arctan2(np.sin(mean), np.cos(mean)),
        unwrapped.std(axis=0, ddof=1),
        np.array(shares),
        phi @ np.linalg.solve(p, phi),
        error[-1] ** 2 / p[2, 2],
    )
