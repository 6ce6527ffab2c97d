"""Notes of a source: choices and warnings that the log and run.json show."""

from __future__ import annotations


class Notes(list[str]):
    """A list of lines in which a line with a key is replaced, not repeated, when it is put again."""

    def __init__(self) -> None:
        super().__init__()
        self._place: dict[str, int] = {}

    def put(self, key: str, line: str) -> None:
        """Add ``line``, or replace the line that was put under ``key`` before."""
        if key in self._place:
            self[self._place[key]] = line
        else:
            self._place[key] = len(self)
            self.append(line)
