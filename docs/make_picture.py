"""The README's picture, made from a finished run: photograph with P(moving) | splat | path from above.

    python docs/make_picture.py runs/demo docs/picture.png

Of the holdout photographs in the run's report, the one with most in motion is shown.
"""

from __future__ import annotations

import base64
import re
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
HEIGHT, GAP, CAPTION = 360, 12, 34
ORANGE, WHITE, GREY, BLUE = (0, 98, 255), (255, 255, 255), (150, 150, 150), (190, 110, 30)  # BGR
PHOTOGRAPH = re.compile(r'<img src="data:image/jpeg;base64,([^"]+)" alt="photograph at ([\d.]+) s"')


def nearest(folder: Path, time_s: float) -> Array:
    """The image of a folder whose name is nearest in time."""
    files = sorted(folder.glob("*.png"))
    if not files:
        sys.exit(f"{folder}: expected images, got none")
    return cv2.imread(str(min(files, key=lambda p: abs(float(p.stem) - time_s))), cv2.IMREAD_COLOR)


def photograph_and_time(run: Path) -> tuple[Array, float]:
    """The holdout photograph of the report in which most moves, and its timestamp in seconds."""
    found = PHOTOGRAPH.findall((run / "report.html").read_text(encoding="utf-8"))
    if not found:
        sys.exit(f"{run}/report.html: expected holdout photographs, got none (was the run made with --no-map?)")
    data, time_s = max(found, key=lambda f: float((nearest(run / "masks", float(f[1])) > 127).mean()))
    return cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR), float(time_s)


def to_height(image: Array, how: int = cv2.INTER_CUBIC) -> Array:
    """The image HEIGHT pixels high, in its own proportions."""
    return cv2.resize(image, (round(image.shape[1] * HEIGHT / image.shape[0]), HEIGHT), interpolation=how)


def with_mask(photograph: Array, mask: Array) -> Array:
    """P(moving) over the photograph in orange, its 0.5 line in white."""
    p = cv2.resize(mask[..., 0], (photograph.shape[1], photograph.shape[0]))
    alpha = (0.55 / 255 * p.astype(np.float32))[..., None]
    out = (photograph * (1 - alpha) + np.array(ORANGE) * alpha).astype(np.uint8)
    lines, _ = cv2.findContours((p > 127).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(out, lines, -1, WHITE, 2, cv2.LINE_AA)


def positions(path: Path) -> Array:
    """(n, 3) camera centres of a TUM file."""
    return np.loadtxt(path, ndmin=2)[:, 1:4]


def path_from_above(run: Path) -> Array:
    """x across, z up, equal axes; keyframes as dots, the start as a ring."""
    every, keyframes = positions(run / "trajectory.txt")[:, [0, 2]], positions(run / "keyframes.txt")[:, [0, 2]]
    low, high = every.min(0), every.max(0)
    scale = (HEIGHT - 70) / max(float((high - low).max()), 1e-9)
    middle = (low + high) / 2

    def at(xz: Array) -> Array:
        return np.rint(16 * (HEIGHT / 2 + (xz - middle) * [scale, -scale])).astype(np.int32)

    canvas = np.full((HEIGHT, HEIGHT, 3), 250, np.uint8)
    cv2.polylines(canvas, [at(every)], False, BLUE, 2, cv2.LINE_AA, 4)
    for point in at(keyframes):
        cv2.circle(canvas, point.tolist(), 16 * 4, BLUE, -1, cv2.LINE_AA, 4)
    cv2.circle(canvas, at(every)[0].tolist(), 16 * 8, ORANGE, 2, cv2.LINE_AA, 4)
    return canvas


def captioned(image: Array, text: str) -> Array:
    """The image with a line of text under it."""
    strip = np.full((CAPTION, image.shape[1], 3), 255, np.uint8)
    cv2.putText(strip, text, (2, 23), cv2.FONT_HERSHEY_SIMPLEX, 0.52, (60, 60, 60), 1, cv2.LINE_AA)
    return np.vstack([image, strip])


def main() -> None:
    """Read the run, write the picture."""
    if len(sys.argv) != 3:
        sys.exit("expected: python docs/make_picture.py RUN_FOLDER PICTURE.png")
    run, out = Path(sys.argv[1]), Path(sys.argv[2])
    if not (run / "report.html").is_file():
        sys.exit(f"{run}: expected the folder of a complete run, got no report.html in it")
    photograph, time_s = photograph_and_time(run)
    panels = [
        captioned(with_mask(to_height(photograph), nearest(run / "masks", time_s)), "photograph, what moves in orange"),
        captioned(to_height(nearest(run / "renders", time_s)), "splat, seen from the same place"),
        captioned(path_from_above(run), "camera path from above, keyframes"),
    ]
    gap = np.full((HEIGHT + CAPTION, GAP, 3), 255, np.uint8)
    if not cv2.imwrite(str(out), np.hstack([panels[0], gap, panels[1], gap, panels[2]])):
        sys.exit(f"{out}: expected a place for a .png file, got none that can be written")


if __name__ == "__main__":
    main()
