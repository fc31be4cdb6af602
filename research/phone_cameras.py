"""Write the presets of phone cameras: `python -m research.phone_cameras opencap_iphone_intrinsics.json`.

The input holds the calibrations of iPhones' main cameras that are published with OpenCap (stanfordnmbl/opencap-core,
commit d5a5258, Apache-2.0; Uhlrich et al. 2023, PLoS Comput Biol 19(10):e1011462): by model identifier and recording
format, the matrix of the upright (portrait) picture in px, five distortion coefficients, height and width.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from research.paths import PACKAGE

SOURCE = (
    "OpenCap's calibrations of iPhones (stanfordnmbl/opencap-core, commit d5a5258, Apache-2.0; "
    "Uhlrich et al. 2023, PLoS Comput Biol 19(10):e1011462)"
)
#: Apple's model identifiers and the names that the Camera app writes into its files.
NAMES = {
    "iPhone8,1": "iPhone 6s",
    "iPhone8,4": "iPhone SE (1st generation)",
    "iPhone10,1": "iPhone 8",
    "iPhone10,2": "iPhone 8 Plus",
    "iPhone10,3": "iPhone X",
    "iPhone10,4": "iPhone 8",
    "iPhone10,5": "iPhone 8 Plus",
    "iPhone10,6": "iPhone X",
    "iPhone11,2": "iPhone XS",
    "iPhone11,4": "iPhone XS Max",
    "iPhone11,6": "iPhone XS Max",
    "iPhone11,8": "iPhone XR",
    "iPhone12,1": "iPhone 11",
    "iPhone12,3": "iPhone 11 Pro",
    "iPhone12,5": "iPhone 11 Pro Max",
    "iPhone12,8": "iPhone SE (2nd generation)",
    "iPhone13,1": "iPhone 12 mini",
    "iPhone13,2": "iPhone 12",
    "iPhone13,3": "iPhone 12 Pro",
    "iPhone13,4": "iPhone 12 Pro Max",
    "iPhone14,2": "iPhone 13 Pro",
    "iPhone14,3": "iPhone 13 Pro Max",
    "iPhone14,4": "iPhone 13 mini",
    "iPhone14,5": "iPhone 13",
    "iPhone14,6": "iPhone SE (3rd generation)",
    "iPhone14,7": "iPhone 14",
    "iPhone14,8": "iPhone 14 Plus",
    "iPhone15,2": "iPhone 14 Pro",
    "iPhone15,3": "iPhone 14 Pro Max",
    "iPhone15,4": "iPhone 15",
    "iPhone15,5": "iPhone 15 Plus",
    "iPhone16,1": "iPhone 15 Pro",
    "iPhone16,2": "iPhone 15 Pro Max",
    "iPhone17,1": "iPhone 16 Pro",
    "iPhone17,2": "iPhone 16 Pro Max",
    "iPhone17,3": "iPhone 16",
    "iPhone17,4": "iPhone 16 Plus",
    "iPhone17,5": "iPhone 16e",
}


def build(published: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """The content of the data file: calibrations that are the same to the last digit once, with all their models."""
    cameras: dict[tuple, dict[str, Any]] = {}
    for key, entry in published.items():
        model = key.split("/")[0]
        (fx, _, cx), (_, fy, cy), _ = entry["intrinsicMat"]
        height, width = (int(row[0]) for row in entry["imageSize"])
        figures = (width, height, fx, fy, cx, cy, *entry["distortion"][0])
        camera = cameras.setdefault(
            figures,
            {
                "models": [],
                "size_px": [width, height],
                "focal_px": [round(fx, 3), round(fy, 3)],
                "centre_px": [round(cx, 3), round(cy, 3)],
                "distortion": [round(d, 6) for d in entry["distortion"][0]],
            },
        )
        if model not in camera["models"]:
            camera["models"].append(model)
    listed = sorted(cameras.values(), key=lambda c: (_number(c["models"][0]), c["size_px"]))
    for camera in listed:
        camera["models"].sort(key=_number)
    return {"source": SOURCE, "names": NAMES, "cameras": listed}


def _number(model: str) -> tuple[int, ...]:
    return tuple(int(n) for n in model.removeprefix("iPhone").split(","))


@click.command(epilog="Example: python -m research.phone_cameras opencap_iphone_intrinsics.json")
@click.argument("published", type=click.Path(path_type=Path, exists=True, dir_okay=False))
def main(published: Path) -> None:
    """Write the presets of phone cameras from the file that OpenCap publishes."""
    content = build(json.loads(published.read_text()))
    out = PACKAGE / "video" / "data" / "phone_cameras.json"
    head = {k: v for k, v in content.items() if k != "cameras"}
    text = json.dumps(head, indent=1)[:-2] + ',\n "cameras": [\n'
    text += ",\n".join("  " + json.dumps(c) for c in content["cameras"]) + "\n ]\n}\n"
    out.write_text(text)
    click.echo(f"{out}: {len(content['cameras'])} calibrations of {len(content['names'])} models")


if __name__ == "__main__":
    main()
