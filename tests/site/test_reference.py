"""The hand-written reference pages agree with the package."""

import ast
import re
from pathlib import Path

import pytest

import sinsjax
from sinsjax.cli import commands_page

DOCS = Path(__file__).parents[2] / "docs"
PACKAGE = Path(sinsjax.__file__).parent


def test_commands_page_is_up_to_date() -> None:
    assert (DOCS / "commands.md").read_text(
        encoding="utf-8"
    ) == commands_page.render_commands_page()


@pytest.mark.slow
def test_documented_messages_exist_in_package_source() -> None:
    """The pieces of a message between its gaps appear in this order in one string of the source."""
    page = (DOCS / "messages.md").read_text(encoding="utf-8")
    cells = re.findall(r"^\| (`.+?`) \|", page, re.M)
    documented = [message for cell in cells for message in re.findall(r"`(.+?)`", cell)]
    assert len(documented) > 100
    texts = [text for path in PACKAGE.rglob("*.py") for text in _texts(path)]
    for message in documented:
        pieces = [piece.strip() for piece in message.split("...")]
        wanted = re.compile(".*".join(re.escape(piece) for piece in pieces if piece), re.DOTALL)
        assert any(wanted.search(text) for text in texts), message


def _texts(path: Path) -> list[str]:
    """Return the strings of a module; values in f-strings are gaps."""
    nodes = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
    return [text for node in nodes if (text := _text(node))]


def _text(node: ast.AST) -> str:
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(map(_text, node.values))
    return "\0" if isinstance(node, ast.FormattedValue) else ""
