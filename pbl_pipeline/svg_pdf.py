"""Charts of `pbl_pipeline.charts` as PDF, through reportlab (the extra `export`)."""

from __future__ import annotations

import importlib.util
import io
import re
import xml.etree.ElementTree as ET  # nosec: of our own charts only
from pathlib import Path
from typing import Any

_SVG = "{http://www.w3.org/2000/svg}"
_FONT, _SIZE = "Vera", 11.0
_ANCHORS = {"start": "drawString", "middle": "drawCentredString", "end": "drawRightString"}


def can_write_pdf() -> bool:
    """Whether reportlab is installed."""
    return importlib.util.find_spec("reportlab") is not None


def svg_to_pdf(svg: str) -> bytes:
    """A chart as a PDF page of its size, with text as text; the same bytes for the same chart.

    Knows the elements that `charts.Axes` draws: line, polyline, polygon, rect, circle, text and groups with an opacity.

    Raises
    ------
    ValueError
        Another element.
    """
    from reportlab.pdfbase import pdfmetrics
    from reportlab.pdfbase.ttfonts import TTFont
    from reportlab.pdfgen.canvas import Canvas

    if _FONT not in pdfmetrics.getRegisteredFontNames():
        import reportlab

        fonts = Path(reportlab.__file__).parent / "fonts"
        pdfmetrics.registerFont(TTFont(_FONT, fonts / "Vera.ttf"))
        pdfmetrics.registerFont(TTFont(f"{_FONT}-Bold", fonts / "VeraBd.ttf"))
    root = ET.fromstring(svg)  # noqa: S314 our own chart
    _, _, width, height = map(float, root.attrib["viewBox"].split())
    data = io.BytesIO()
    canvas: Any = Canvas(data, (width, height), invariant=1, pageCompression=1)
    canvas.setTitle(root.attrib.get("aria-label", ""))
    _draw(canvas, root, height, 1.0)
    canvas.save()
    return data.getvalue()


def _draw(canvas: Any, parent: ET.Element, height: float, opacity: float) -> None:
    for element in parent:
        kind, a = element.tag.removeprefix(_SVG), element.attrib
        if kind == "g":
            _draw(canvas, element, height, opacity * float(a.get("opacity", 1)))
            continue
        _colours(canvas, a, opacity)
        marks = {"stroke": int(a.get("stroke", "none") != "none"), "fill": int(a.get("fill", "none") != "none")}
        if kind == "line":
            canvas.line(float(a["x1"]), height - float(a["y1"]), float(a["x2"]), height - float(a["y2"]))
        elif kind in ("polyline", "polygon"):
            path = canvas.beginPath()
            for i, pair in enumerate(a["points"].split()):
                x, y = map(float, pair.split(","))
                (path.lineTo if i else path.moveTo)(x, height - y)
            if kind == "polygon":
                path.close()
            canvas.drawPath(path, **marks)
        elif kind == "rect":
            x, y, w, h = (float(a[k]) for k in ("x", "y", "width", "height"))
            canvas.rect(x, height - y - h, w, h, **marks)
        elif kind == "circle":
            canvas.circle(float(a["cx"]), height - float(a["cy"]), float(a["r"]), **marks)
        elif kind == "text":
            size = re.search(r"font-size:([\d.]+)px", a.get("style", ""))
            canvas.setFont(_FONT + ("-Bold" if "font-weight" in a else ""), 0.9 * float(size[1] if size else _SIZE))
            draw = getattr(canvas, _ANCHORS[a.get("text-anchor", "start")])
            draw(float(a["x"]), height - float(a["y"]), element.text or "")
        else:
            raise ValueError(f"no way to draw {kind!r} as PDF")


def _colours(canvas: Any, a: dict[str, str], opacity: float) -> None:
    """Pen and brush of an element."""
    from reportlab.lib.colors import HexColor

    if a.get("fill", "none") != "none":
        canvas.setFillColor(_full(HexColor, a["fill"]))
        canvas.setFillAlpha(opacity * float(a.get("fill-opacity", 1)))
    if a.get("stroke", "none") != "none":
        canvas.setStrokeColor(_full(HexColor, a["stroke"]))
        canvas.setStrokeAlpha(opacity * float(a.get("stroke-opacity", 1)))
        canvas.setLineWidth(float(a.get("stroke-width", 1)))
        dash = a.get("stroke-dasharray", "none")
        canvas.setDash([] if dash == "none" else [float(v) for v in dash.split()])
        canvas.setLineJoin(1)


def _full(colour: Any, text: str) -> Any:
    """#fff is #ffffff."""
    return colour("#" + "".join(2 * c for c in text[1:]) if len(text) == 4 else text)
