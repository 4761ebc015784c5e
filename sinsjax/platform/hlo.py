"""What XLA compiled a program to, read from its optimised HLO text.

``XLA_FLAGS`` only shows what was requested: XLA ignores an extra option it does not know, and any
option set after it has started. The compiled program shows what took effect.
"""

import re

import jax
import jax.numpy as jnp

_HEAD = re.compile(r"^(?:ENTRY )?%?([\w.-]+) .*\{$")
_CALLEES = re.compile(r"=\{?((?:%?[\w.-]+(?:, )?)+)")
_WHILE = re.compile(r" while\(.*\bbody=%?([\w.-]+)")
_SMALL_CALL = re.compile(r' call\(.*\bto_apply=%?([\w.-]+).*xla_cpu_small_call="true"')
_TUPLE_FUSION = re.compile(r"= \(.*\) fusion\(")


def fused_loop_present(program: str | jax.stages.Compiled) -> bool:
    """Whether XLA:CPU compiled each innermost loop of a program into one native function.

    XLA wraps such a loop in a call marked ``xla_cpu_small_call``; every innermost loop must lie
    inside one.

    Args:
        program: a program compiled for the CPU, or its HLO text.

    Returns:
        False if an innermost loop runs one fusion at a time, or if there is no loop.
    """
    text = program if isinstance(program, str) else program.as_text() or ""
    bodies = _computations(text)
    callees = {
        name: {
            callee.strip(" %")
            for line in lines
            for group in _CALLEES.findall(line)
            for callee in group.split(",")
        }
        & bodies.keys()
        for name, lines in bodies.items()
    }

    def reach(roots: set[str]) -> set[str]:
        seen: set[str] = set()
        ahead = set(roots)
        while ahead:
            seen |= ahead
            ahead = set().union(*(callees[name] for name in ahead)) - seen
        return seen

    loops = {
        name: [m[1] for line in lines if (m := _WHILE.search(line))]
        for name, lines in bodies.items()
    }
    fused = reach({m[1] for m in map(_SMALL_CALL.search, text.splitlines()) if m})
    innermost = [
        name
        for name, loop_bodies in loops.items()
        for body in loop_bodies
        if not any(loops[inner] for inner in reach({body}))
    ]
    return bool(innermost) and all(name in fused for name in innermost)


def options_seen() -> dict[str, bool | None]:
    """Whether the XLA options are in effect in this process, as seen in a tiny compiled loop.

    The loop carries more bytes than XLA's default limit for a small loop.

    Returns:
        ``fused_loop`` and ``multi_output_fusion``; None if JAX has no CPU backend.
    """

    def step(carry: tuple[jax.Array, jax.Array], t: jax.Array) -> tuple:
        a, b = carry
        product = jnp.sin(a) * b
        return (product + t, product * 0.5 + b), None

    def loop(x: jax.Array) -> tuple:
        return jax.lax.scan(step, (x, x), jnp.arange(7, dtype=jnp.float32))[0]

    try:
        cpu = jax.local_devices(backend="cpu")[0]
    except RuntimeError:
        return {"fused_loop": None, "multi_output_fusion": None}
    with jax.default_device(cpu):
        lowered = jax.jit(loop).lower(jax.ShapeDtypeStruct((32768,), jnp.float32))
    text = lowered.compile().as_text() or ""
    return {
        "fused_loop": fused_loop_present(text),
        "multi_output_fusion": _TUPLE_FUSION.search(text) is not None,
    }


def _computations(text: str) -> dict[str, list[str]]:
    """The lines of every computation in HLO text, by name."""
    bodies: dict[str, list[str]] = {}
    lines: list[str] = []
    for line in text.splitlines():
        if head := _HEAD.match(line):
            lines = bodies.setdefault(head[1], [])
        else:
            lines.append(line)
    return bodies
