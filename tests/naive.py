"""The engine once more, naively: NumPy, dense matrices, one run, written from the equations.

Slow and plain on purpose. Nothing here comes from the filter, mechanisation or error model that
it is compared with. Vectors and matrices are arrays, attitude is a matrix C_b^n.
"""

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
    """Numbers and choices of a closed loop."""

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


class History(NamedTuple):
    """After every sample: attitude, velocity, place, estimate, covariance, fed-back biases."""

    c: np.ndarray
    v: np.ndarray
    latitude: np.ndarray
    longitude: np.ndarray
    x: np.ndarray
    p: np.ndarray
    bias: np.ndarray


def mechanise(c, v, turn, dv, planet, latitude, dt):
    """C, V after one sample and the mean f^n over it, from the sample's rotation and velocity."""
    w_ie, w_en = planet.rates(latitude, v)
    w_in = w_ie + w_en
    f = (c @ dv - np.cross(w_in * dt / 2, c @ dv)) / dt
    coriolis = np.cross(2 * w_ie + w_en, [*v, 0.0])
    return exp(-w_in * dt) @ c @ turn, v + dt * (f - coriolis)[:2], f


def update(x, p, h, z, r):
    """The joint Kalman update with H, R = r I."""
    gain = p @ h.T @ np.linalg.inv(h @ p @ h.T + r * np.eye(len(h)))
    return x + gain @ (z - h @ x), (np.eye(len(x)) - gain @ h) @ p


def reset(p, filt):
    """P after a reset."""
    p0 = np.diag(filt.p0)
    if filt.kind == "full":
        return p0
    if filt.kind == "scale":
        return filt.factor * p
    out = p.copy()
    out[4, :] = out[:, 4] = 0.0
    out[4, 4] = p0[4, 4]
    return out


def closed_loop(increments, dt, planet, *, latitude, c, v, filt):
    """Mechanise, predict, update, feed back and reset, sample after sample."""
    n = len(filt.p0)
    theta, dvs = compensate(increments)
    turns = Rotation.from_rotvec(theta).as_matrix()
    x, p, bias = np.zeros(n), np.diag(filt.p0), np.zeros(n - 5)
    h = np.eye(n)[:2]
    longitude, fixed, history = 0.0, latitude, []
    for k, (turn, dv) in enumerate(zip(turns, dvs, strict=True), start=1):
        at = latitude if filt.position == "integrated" else fixed
        # The gravity reading linearises about a base at rest.
        v0, c0 = v * (filt.force != "gravity"), c
        if n == 10:
            turn = turn @ exp(-bias[2:] * dt)
            dv = dv - np.array([*bias[:2], 0.0]) * dt
        c, v, f = mechanise(c, v, turn, dv, planet, at, dt)
        if filt.position == "integrated":
            rm, rn = planet.radii(at)
            latitude, longitude = (
                at + v[1] / rm * dt,
                longitude + v[0] / (rn * np.cos(at)) * dt,
            )
        if filt.force == "gravity":
            f = np.array([0.0, 0.0, planet.g(at)])
        a = error_matrix(v0, f, planet, at) if n == 5 else error_matrix_10(v0, f, planet, at, c0)
        phi = np.eye(n) + a * dt
        x, p = phi @ x, phi @ p @ phi.T + np.diag(filt.q)
        x, p = update(x, p, h, v, filt.r)
        share = 1.0 if k in filt.resets else filt.gain if k % filt.every == 0 else 0.0
        if share:
            v = v - share * x[:2]
            c = exp(share * x[2:5]) @ c
            bias = bias + share * x[5:]
            x = (1 - share) * x
        if k in filt.resets:
            p = reset(p, filt)
        history.append((c, v, latitude, longitude, x, p, bias))
    return History(*(np.array(column) for column in zip(*history, strict=True)))


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
    for band in bands:
        bad = [t for t, e in zip(times, error, strict=True) if not abs(e) <= band]
        outside.append(bad[-1] if bad else 0.0)
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
