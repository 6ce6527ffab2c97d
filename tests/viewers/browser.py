"""Pages in headless Chromium, for tests of the viewer and of the report. Needs what ``show.py`` needs."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

from viewers.show import PAGES, tools, viewer_modules


class Browser:
    """One Chromium. Raises Missing where it cannot be run."""

    def __init__(self) -> None:
        chromium, node, _ = tools()
        words = [node, str(PAGES / "browse.mjs"), str(viewer_modules()), chromium]
        self._process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self._read()

    def open(self, url: str, width: int, height: int, out: Path | None = None, **asked: Any) -> dict[str, Any]:
        """Do one job of ``browse.mjs``, with a screenshot to ``out``. Raises RuntimeError where the page fails."""
        job = {"url": url, "width": width, "height": height, "out": None if out is None else str(out), **asked}
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(job) + "\n")
        self._process.stdin.flush()
        answer: dict[str, Any] = json.loads(self._read())
        if "error" in answer:
            raise RuntimeError(answer["error"])
        return answer

    def _read(self) -> str:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError("the browser has ended")
        return line

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.communicate(timeout=60)
