"""A notebook with its stored outputs as Markdown."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any


def markdown(path: Path) -> str:
    """Text, code and outputs of the notebook in their order.

    Raises
    ------
    ValueError
        An output of a kind that no page can show.
    """
    parts = []
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        text = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(text)
        elif cell["cell_type"] == "code":
            parts += [f"```python\n{text}\n```", *map(_output, cell.get("outputs", []))]
    return "\n\n".join(parts) + "\n"


def _output(output: dict[str, Any]) -> str:
    if output["output_type"] == "stream":
        return _text("".join(output["text"]))
    data = {kind: "".join(lines) for kind, lines in output.get("data", {}).items()}
    for kind in ("image/svg+xml", "text/html"):
        if kind in data:  # no empty line: Markdown would end the block there
            html = re.sub(r"\n\s*\n", "\n", re.sub(r"<style.*?</style>", "", data[kind], flags=re.DOTALL))
            return f'<div class="output">\n{html.strip()}\n</div>'
    if "text/plain" in data:
        return _text(data["text/plain"])
    raise ValueError(f"an output of {sorted(data) or output['output_type']}: what of it should a page show?")


def _text(text: str) -> str:
    return f"```text\n{text.rstrip()}\n```"
