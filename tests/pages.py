"""The pages of the documentation as tests read them: their text, links, code blocks and commands."""

import dataclasses
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import docs_site

ROOT = Path(__file__).resolve().parents[1]
_FENCE = re.compile(r"^```(\w*)\n(.*?)^```[^\n]*$", re.MULTILINE | re.DOTALL)


@dataclasses.dataclass(frozen=True)
class Block:
    """A block of code: `page` is its path in the repository, `number` counts those of its language there from 0."""

    page: str
    language: str
    number: int
    code: str


def pages() -> list[str]:
    """Path in the repository of every page in Markdown, the history left out."""
    return [path for path in docs_site.pages() if path.endswith(".md") and path != "CHANGELOG.md"]


def text(page: str) -> str:
    return (ROOT / page).read_text(encoding="utf-8")


def prose(page: str) -> str:
    """The page without its code blocks."""
    return _FENCE.sub("", text(page))


def blocks(page: str) -> Iterator[Block]:
    counts: dict[str, int] = {}
    for language, code in _FENCE.findall(text(page)):
        number = counts[language] = counts.get(language, -1) + 1
        yield Block(page, language, number, code)


def python_blocks() -> list[Block]:
    return [b for page in pages() for b in blocks(page) if b.language == "python"]


def commands(code: str) -> list[list[str]]:
    """The words of every call of `pbl` in a shell block or a help text."""
    found = []
    for line in code.replace("\\\n", " ").splitlines():
        line = re.sub(r"^\s*Example: ", "", line).strip()
        for part in re.split(r"&&|\|\|?|;|\s[#>]", line):
            if part.strip().startswith("pbl "):
                found.append(shlex.split(part)[1:])
    return found


def commands_in_prose(page: str) -> list[list[str]]:
    """The words of every `pbl ...` between backticks; of "a|b" the first, without "..." and brackets."""
    found = []
    for code in re.findall(r"`pbl ([^`\n]+)`", prose(page)):
        words = re.sub(r"[\[\]]|\.\.\.", " ", code).split()
        found.append([w.split("|")[0] if re.fullmatch(r"[a-z]+(\|[a-z]+)+", w) else w for w in words])
    return found
