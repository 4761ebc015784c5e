import jax
import jax.numpy as jnp
import pytest

from sinsjax.platform import xla
from sinsjax.platform.hlo import fused_loop_present, options_seen

pytestmark = pytest.mark.slow


def hlo(**computations: str) -> str:
    """HLO text as XLA prints it, from the instructions of each computation; ENTRY is `main`."""
    parts = ["HloModule jit_f, is_scheduled=true, entry_computation_layout={()->f32[8]{0}}", ""]
    for name, lines in computations.items():
        entry = "ENTRY " if name == "main" else ""
        parts += [f"{entry}%{name} (x.1: f32[8]) -> f32[8] {{", f"  {lines}", "}", ""]
    return "\n".join(parts)


def loop(body: str) -> str:
    return (
        f"ROOT %while.0 = (s32[], /*index=1*/f32[8]{{0}}) while(%t), condition=%test, body=%{body},"
        ' backend_config={"known_trip_count":{"n":"7"}}'
    )


def small_call(callee: str) -> str:
    return (
        f"%call = (s32[], f32[8]{{0}}) call(%t), to_apply=%{callee},"
        ' frontend_attributes={xla_cpu_small_call="true"}, metadata={op_name="jit(f)/while"}'
    )


TEST = "ROOT %lt.0 = pred[] compare(%a, %b), direction=LT"
STEP = "ROOT %add = f32[8]{0} fusion(%x.1), kind=kLoop, calls=%fused_computation"


@pytest.mark.parametrize(
    ("text", "fused"),
    [
        (hlo(main=STEP), False),
        (hlo(step=STEP, test=TEST, main=loop("step")), False),
        (hlo(step=STEP, test=TEST, inner=loop("step"), main=small_call("inner")), True),
        # An outer loop may run piece by piece as long as the inner one is fused,
        (
            hlo(
                step=STEP,
                test=TEST,
                inner=loop("step"),
                outer=small_call("inner"),
                main=loop("outer"),
            ),
            True,
        ),
        # a fused outer loop takes its inner loops along,
        (
            hlo(
                step=STEP,
                test=TEST,
                inner=loop("step"),
                outer=loop("inner"),
                main=small_call("outer"),
            ),
            True,
        ),
        # and one loose innermost loop is one too many.
        (
            hlo(
                step=STEP,
                test=TEST,
                inner=loop("step"),
                main=small_call("inner") + "\n  " + loop("step"),
            ),
            False,
        ),
    ],
)
def test_every_innermost_loop_must_be_fused(text, fused):
    assert fused_loop_present(text) is fused


@pytest.mark.skipif(xla.opted_out(), reason="the XLA options are opted out of")
def test_xla_options_are_active_in_this_process():
    assert options_seen() == {"fused_loop": True, "multi_output_fusion": True}


@pytest.mark.skipif(xla.opted_out(), reason="the XLA options are opted out of")
def test_compiled_program_with_unfusable_loop_is_detected():
    def nested(x, inner):
        def record(x, _):
            return jax.lax.scan(lambda x, _: (inner(x), None), x, length=5)[0], x

        return jax.lax.map(lambda x: jax.lax.scan(record, x, length=3), x)

    def compiled(inner):
        x = jax.ShapeDtypeStruct((2, 64, 4), jnp.float64)
        return jax.jit(lambda x: nested(x, inner)).lower(x).compile()

    assert fused_loop_present(compiled(lambda x: jnp.sin(x) * 0.5 + x))
    # Sorting is a call into a library: XLA leaves its loop as it is.
    assert not fused_loop_present(compiled(lambda x: jnp.sort(x, axis=0)))
