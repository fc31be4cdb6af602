"""How often cut feet and a cut head are noticed while filming, on crops of recordings whose person is whole.

    python -m research.benchmarks.framing VIDEO ...

Every tenth picture in which the person is whole and takes a quarter of its height is cut at the feet and at the head
by shares of the person's height (from eyes to feet; the crown is 0.07 above), made as small as the phone's page makes
it, and looked at. Prints for each share how many pictures say what.
"""

from __future__ import annotations

import sys
from collections import Counter

import click
import cv2
import numpy as np

from pbl_pipeline.keypoints.framing import Framing
from pbl_pipeline.video import guess_camera, read_frames
from tests import not_none

#: Shares of the height between the feet, or the crown, and the border; below 0 they are cut off.
SHARES = (0.2, 0.1, 0.05, 0.02, -0.02, -0.05, -0.1, -0.2)
CROWN, SIDE_PX = 0.07, 640


def small(image: np.ndarray) -> np.ndarray:
    """A picture as the phone's page sends it."""
    scale = min(1.0, SIDE_PX / max(image.shape[:2]))
    packed = cv2.imencode(".jpg", cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA),
                          [cv2.IMWRITE_JPEG_QUALITY, 70])[1]  # fmt: skip
    return not_none(cv2.imdecode(packed, cv2.IMREAD_COLOR))


def main(paths: list[str]) -> None:
    framing = Framing()
    seen: dict[tuple[str, float], Counter[str]] = {}
    for path in paths:
        for frame in read_frames(path):
            if frame.index % 10:
                continue
            image = frame.image
            height, width = image.shape[:2]
            people = framing._detector.detect(image)
            if not people:
                continue
            person = framing._points.detect(image, people[0].roi_px, guess_camera((width, height)), quick=True)
            y = person.xy_px[:, 1]
            low, high = y[framing._feet].max(), y[framing._head].min()
            tall = low - high
            if person.presence < 0.9 or tall < height / 4 or low > 0.97 * height or high - CROWN * tall < 0.03 * height:
                continue
            for share in SHARES:
                foot, crown = round(low + share * tall), round(high - (CROWN + share) * tall)
                for what, part in (("feet", image[: min(foot, height)]), ("head", image[max(crown, 0) :])):
                    if (what == "feet" and foot <= height) or (what == "head" and crown >= 0):
                        said = framing.cut_off(small(part))
                        seen.setdefault((what, share), Counter())["no one" if said is None else said or "whole"] += 1
    for (what, share), counts in sorted(seen.items()):
        click.echo(f"{what} {share:+.2f}: " + ", ".join(f"{k} {n}" for k, n in sorted(counts.items())))


if __name__ == "__main__":
    main(sys.argv[1:])
