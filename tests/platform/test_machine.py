"""The instruction set; and a folder that nobody else can write in or put another in place of."""

import os
import stat
from pathlib import Path
from types import SimpleNamespace

import pytest

from sinsjax.platform import machine

SOMEBODY = 54321


X86 = "fpu sse4_2 avx f16c"


@pytest.mark.parametrize(
    ("told", "limit", "expected"),
    [
        ({"flags": X86}, "", "AVX"),
        ({"flags": f"{X86} avx2 avx512f avx512_bf16 amx_tile"}, "", "AVX512"),
        ({"flags": f"{X86} avx2 avx512f"}, "avx2", "AVX2"),
        ({"flags": X86}, "AVX2", "AVX"),
        ({"flags": "fpu sse2"}, "", "x86_64"),
        ({"Features": "fp asimd sve2 sve"}, "", "SVE"),
        ({"Features": "fp asimd"}, "", "NEON"),
        ({}, "", "x86_64"),
        ({}, "AVX2", "x86_64 to AVX2"),
    ],
)
def test_instruction_set_follows_cpu_flags_and_xla_limit(
    monkeypatch: pytest.MonkeyPatch, told: dict[str, str], limit: str, expected: str
) -> None:
    monkeypatch.setattr(machine, "cpu_info", lambda: told)
    monkeypatch.setattr(machine.platform, "machine", lambda: "x86_64")
    assert machine.instruction_set(limit) == expected


modes = pytest.mark.skipif(not hasattr(os, "geteuid"), reason="this system has no such modes")


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def refusal(folder: Path) -> tuple[str, str]:
    """Return where and why a folder is not safe; nothing is created."""
    root = next(place for place in folder.parents if place.exists())
    before = sorted(root.rglob("*"))
    with pytest.raises(machine.UnsafeFolderError) as told:
        machine.ensure_private_folder(folder)
    assert sorted(root.rglob("*")) == before
    return told.value.filename, told.value.strerror


@modes
def test_missing_folders_are_created_private_to_user(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        assert (
            machine.ensure_private_folder(tmp_path / "a" / "b") == (tmp_path / "a" / "b").resolve()
        )
    finally:
        os.umask(before)
    assert mode(tmp_path / "a") == mode(tmp_path / "a" / "b") == 0o700
    machine.ensure_private_folder(tmp_path / "a" / "b")


@modes
@pytest.mark.parametrize("between", ["", "deep/"])
def test_folder_below_world_writable_parent_is_refused(tmp_path: Path, between: str) -> None:
    (tmp_path / "open").mkdir()
    (tmp_path / "open").chmod(0o777)
    leaf = tmp_path / "open" / f"{between}leaf"
    assert refusal(leaf) == (str(tmp_path / "open"), "other users can write there")
    # Also where it was there already, as safe as can be.
    leaf.mkdir(mode=0o700, parents=True)
    assert refusal(leaf) == (str(tmp_path / "open"), "other users can write there")


@modes
def test_sticky_parent_is_accepted_only_if_owned_by_root(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sticky = tmp_path / "sticky"
    sticky.mkdir()
    sticky.chmod(0o1777)
    if os.geteuid() == 0:
        machine.ensure_private_folder(sticky / "leaf")
        os.chown(sticky, SOMEBODY, SOMEBODY)
        assert refusal(sticky / "new") == (str(sticky), "owned by another user")
    else:
        assert refusal(sticky / "leaf") == (str(sticky), "other users can write there")
    assert refusal(sticky)[0] == str(sticky)


@modes
@pytest.mark.skipif(not hasattr(os, "chown") or os.geteuid() != 0, reason="needs a second user")
def test_folder_below_parent_of_another_user_is_refused(tmp_path: Path) -> None:
    """A closed folder stays closed: its owner opens it if needed."""
    theirs = tmp_path / "theirs"
    theirs.mkdir(mode=0o700)
    os.chown(theirs, SOMEBODY, SOMEBODY)
    assert refusal(theirs / "leaf") == (str(theirs), "owned by another user")


@modes
def test_links_are_followed_once_and_their_targets_checked(tmp_path: Path) -> None:
    (tmp_path / "open").mkdir()
    (tmp_path / "open").chmod(0o777)
    (tmp_path / "mine").mkdir()
    (tmp_path / "open" / "link").symlink_to(tmp_path / "mine")
    found = machine.ensure_private_folder(tmp_path / "open" / "link" / "leaf")
    assert found == (tmp_path / "mine" / "leaf").resolve()
    (tmp_path / "mine" / "link").symlink_to(tmp_path / "open")
    assert refusal(tmp_path / "mine" / "link" / "leaf")[0] == str(tmp_path / "open")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with pytest.raises(OSError, match="loop"):
        machine.ensure_private_folder(tmp_path / "loop" / "leaf")


@modes
def test_folder_replaced_by_link_during_creation_raises(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make = Path.mkdir

    def late(place: Path, mode: int = 0o777) -> None:
        (tmp_path / "theirs").symlink_to(tmp_path)
        make(place, mode)

    monkeypatch.setattr(Path, "mkdir", late)
    with pytest.raises(NotADirectoryError, match="theirs"):
        machine.ensure_private_folder(tmp_path / "theirs")


GROUPS = [
    ("private", ["me", "other"], [], True),
    ("private", ["me"], ["me", "root"], True),
    ("private", ["me"], ["me", "other"], False),
    ("users", ["me", "other"], [], True),
    ("users", ["me", "primary"], [], False),
    ("users", [], [], False),
    ("me", [], [], True),
    ("me", [], ["other"], False),
]
"""Name of the group, listed accounts (``primary`` has it as its own), members, only member?"""


@modes
@pytest.mark.parametrize(("group", "accounts", "members", "alone"), GROUPS)
def test_group_writable_parent_is_accepted_only_without_other_members(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    group: str,
    accounts: list[str],
    members: list[str],
    alone: bool,
) -> None:
    import grp
    import pwd

    (tmp_path / "shared").mkdir()
    (tmp_path / "shared").chmod(0o770)
    own = (tmp_path / "shared").stat().st_gid
    listed = [
        SimpleNamespace(pw_name=name, pw_gid=own if name in ("me", "primary") else own + 1)
        for name in accounts
    ]
    monkeypatch.setattr(pwd, "getpwuid", lambda user: SimpleNamespace(pw_name="me"))
    monkeypatch.setattr(pwd, "getpwall", lambda: listed)
    about = SimpleNamespace(gr_name=group, gr_mem=members)
    monkeypatch.setattr(grp, "getgrgid", lambda number: about)
    if alone:
        machine.ensure_private_folder(tmp_path / "shared" / "leaf")
        # Those whom an access control list names are in no group.
        monkeypatch.setattr(machine.os, "listxattr", lambda *_, **__: [machine._ACL], raising=False)
    assert refusal(tmp_path / "shared" / "new")[0] == str(tmp_path / "shared")
