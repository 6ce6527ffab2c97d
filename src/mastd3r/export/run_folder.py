"""The run folder: the one place where a run's files are written."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..camera.pinhole import Camera
from ..concurrency import undivided
from ..errors import OutputError, SlamError, reason_of
from ..types import StaticCloud, Trajectory
from .claim import FOLDERS, RESERVE, UNFINISHED, check_not_in_use, check_ours, claim, remove_segments, settle
from .files import write_bytes, write_json, write_text, writing
from .machine import machine_info
from .point_cloud import write_cloud
from .run_log import RunLog
from .tracks import Tracks, write_tracks
from .trajectory_files import write_tum

Array = NDArray[Any]
RESERVE_BYTES = 2**20  # given back when the disk is full, so that the end of a run can still be written


def stamp(timestamp_s: float) -> str:
    """A timestamp as file names and trajectory rows write it: six decimals."""
    return f"{timestamp_s:.6f}"


class RunFolder:
    """A folder that holds one run. ``run.json`` says "running" until ``finish``; files that no run writes stay.

    ``path`` is where files are written now: another folder within the one that was asked for while an earlier run
    stands there, and from ``finish`` of a complete run on the one that was asked for. As a context it writes what is
    logged to ``run.log``, and whatever ends the block, the run has ended. Raises OutputError as ``claim`` does;
    ``inputs`` are the paths that the run reads, ``overwrite`` removes an earlier run at once.
    """

    def __init__(
        self,
        path: Path | str,
        command: Sequence[str] = (),
        inputs: Sequence[Path] = (),
        *,
        overwrite: bool = False,
    ) -> None:
        self.home = Path(path)
        self.path = claim(self.home, inputs, overwrite=overwrite)
        self.log = RunLog(self.path / "run.log")
        self.record: dict[str, Any] = {
            "status": "running",
            "reason": None,
            "command": list(command),
            "started": _now(),
            "finished": None,
            "machine": machine_info(),
            "choices": [],
            "timings_s": {},
        }
        write_bytes(self.path / RESERVE, os.urandom(RESERVE_BYTES))
        self._save()
        self.log.begin(self.record)
        if self.path != self.home:
            self.note(f"{self.home} holds an earlier run: it is replaced once this one is complete")

    @classmethod
    def again(cls, path: Path, record: dict[str, Any]) -> RunFolder:
        """A folder to write files of a run in that has ended: nothing is removed; ``record`` is its run.json."""
        folder = cls.__new__(cls)
        folder.home = folder.path = Path(path)
        folder.log, folder.record = RunLog(folder.path / "run.log"), record
        return folder

    @classmethod
    def going_on(cls, path: Path, record: dict[str, Any]) -> RunFolder:
        """The folder of a run that was stopped, and is running again. Raises OutputError."""
        check_ours(path)
        check_not_in_use(path)
        folder = cls.again(path, record)
        folder.home = path.parent if path.name == UNFINISHED else path
        for name in FOLDERS:
            with writing(path):
                (path / name).mkdir(exist_ok=True)
        write_bytes(path / RESERVE, os.urandom(RESERVE_BYTES))
        folder.update(status="running", reason=None, finished=None)
        return folder

    def __enter__(self) -> RunFolder:
        self.log.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Whatever stops the run, run.json says so, and run.log holds where an unexpected error came from."""
        with undivided():
            if error is not None and self.record["status"] == "running":
                with suppress(SlamError):
                    self.finish("incomplete", reason_of(error))
            if error is not None:
                self.log.ended_by(error)
                if self.path != self.home:
                    error.add_note(f"it is {self.path}, the earlier run in {self.home} stays")
            self.log.close()

    def update(self, **fields: Any) -> None:
        """Add fields to run.json, or replace them."""
        self.record.update(fields)
        self._save()

    def note(self, *choices: str) -> None:
        """Add lines to the choices made in run.json, each once."""
        self.record["choices"] += [c for c in dict.fromkeys(choices) if c not in self.record["choices"]]
        self._save()

    def finish(self, status: str = "complete", reason: str | None = None) -> None:
        """Close the run: ``complete``, or ``incomplete`` with the reason in one line.

        A complete run takes the place of an earlier one. Nothing may be written afterwards.
        """
        if status not in {"complete", "incomplete"} or (status == "incomplete") != bool(reason):
            raise ValueError(f"expected complete, or incomplete with a reason; got {status!r}, {reason!r}")
        self.make_room()
        if status == "complete":
            with writing(self.path):
                remove_segments(self.path)
        self.update(**self.ending(status, reason))
        if status == "complete" and self.path != self.home:
            self.log.close()
            settle(self.home)
            self.path = self.home

    def ending(self, status: str = "complete", reason: str | None = None) -> dict[str, Any]:
        """What ``finish`` puts into run.json: for who tells of the end before it is there."""
        return {"status": status, "reason": reason, "finished": self.record["finished"] or _now()}

    def make_room(self) -> None:
        """Give back the reserved space, for the last small files on a full disk."""
        with suppress(OSError):
            (self.path / RESERVE).unlink()

    def write_config(self, yaml_text: str) -> None:
        """config.yaml: the effective configuration."""
        write_text(self.path / "config.yaml", yaml_text)

    def write_trajectory(self, trajectory: Trajectory) -> None:
        """trajectory.txt, keyframes.txt and states.txt: how frames came by their poses, which goes to run.json too."""
        write_tum(self.path / "trajectory.txt", trajectory)
        write_tum(self.path / "keyframes.txt", trajectory.keyframes())
        pairs = zip(trajectory.states, trajectory.world_from_cam, strict=True)
        states = [state for state, pose in pairs if np.isfinite(pose).all()]
        rows = (f"{t:.6f} {s}\n" for t, s in zip(trajectory.timestamps_s, trajectory.states, strict=True))
        write_text(self.path / "states.txt", "# timestamp state\n" + "".join(rows))
        self.update(states=_run_lengths(states))

    def write_camera(self, camera: Camera, distortion: Sequence[float] | None = None, **known: Any) -> None:
        """camera.json: the lens, in pixels of the full-size image, and its distortion in OpenCV's order.

        ``distortion`` holds what ``camera`` cannot (k1 k2 p1 p2 [k3 [k4 k5 k6]]); without it, the camera's own terms.
        ``known``: what else is said of it, such as where the focal length comes from (read_run.py:NOT_OF_THE_LENS).
        """
        own = (camera.k1, camera.k2, 0.0, 0.0, camera.k3)
        distorted = list(own if distortion is None else distortion)
        self.write_json("camera.json", {**dataclasses.asdict(camera), "distortion": distorted, **known})

    def write_cloud(self, cloud: StaticCloud) -> None:
        """cloud.ply: the dense static map."""
        write_cloud(self.path / "cloud.ply", cloud)

    def write_tracks(self, tracks: Tracks) -> None:
        """tracks.npz: static points, and where frames were measured to see them."""
        write_tracks(self.path / "tracks.npz", tracks)

    def write_mask(self, timestamp_s: float, probability: Array) -> None:
        """masks/<timestamp>.png: P(moving), (h, w) in 0..1. A value above 127 is P > 0.5."""
        if probability.ndim != 2 or not np.isfinite(probability).all():
            raise OutputError(
                f"mask at {stamp(timestamp_s)} s: expected finite (h, w) probabilities, got shape "
                f"{probability.shape}, {int((~np.isfinite(probability)).sum())} not finite"
            )
        levels = np.ceil(np.clip(probability, 0, 1) * 255 - 0.5).astype(np.uint8)
        write_png(self.path / "masks", timestamp_s, levels)

    def write_render(self, timestamp_s: float, image: Array) -> None:
        """renders/<timestamp>.png: (h, w, 3) RGB, uint8 or float in 0..1."""
        if image.dtype != np.uint8:
            if not np.isfinite(image).all():
                raise OutputError(f"render at {stamp(timestamp_s)} s: expected finite colours, got some that are not")
            image = np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)
        write_png(self.path / "renders", timestamp_s, np.ascontiguousarray(image[..., ::-1]))

    def write_alpha(self, timestamp_s: float, alpha: Array) -> None:
        """alpha/<timestamp>.png: (h, w) in 0..1, how opaque the render of the same name is."""
        write_png(self.path / "alpha", timestamp_s, np.rint(np.clip(alpha, 0, 1) * 255).astype(np.uint8))

    def write_depth(self, timestamp_s: float, depth: Array, per_unit: float) -> None:
        """depth/<timestamp>.png, see ``write_depth_png``."""
        write_depth_png(self.path / "depth", timestamp_s, depth, per_unit)

    def write_aligned(self, rows: Array) -> None:
        """aligned.txt: (n, 7) time, estimated position in the truth's frame, true position; for plots."""
        lines = [f"{row[0]:.6f} " + " ".join(f"{v:.6f}" for v in row[1:]) + "\n" for row in rows]
        head = "# timestamp_s x y z true_x true_y true_z (truth's frame and unit, after Sim(3) alignment)\n"
        write_text(self.path / "aligned.txt", head + "".join(lines))

    def write_metrics(self, metrics: dict[str, Any]) -> None:
        """metrics.json: flat keys."""
        self.write_json("metrics.json", metrics)

    def write_json(self, name: str, data: dict[str, Any]) -> None:
        """Any other small file of the run."""
        write_json(self.path / name, data)

    def _save(self) -> None:
        write_json(self.path / "run.json", self.record)


def write_depth_png(folder: Path, timestamp_s: float, depth: Array, per_unit: float) -> None:
    """<timestamp>.png in ``folder``: (h, w) depth in map units as 16 bit, ``per_unit`` steps a unit.

    0 = nothing there; what is too far for 16 bit is 65535. Raises OutputError.
    """
    if not np.isfinite(depth).all():
        raise OutputError(f"depth at {stamp(timestamp_s)} s: expected finite depths, got some that are not")
    write_png(folder, timestamp_s, np.rint(np.clip(depth * per_unit, 0, 65535)).astype(np.uint16))


def write_png(folder: Path, timestamp_s: float, image: Array) -> None:
    """<timestamp>.png in ``folder``; colours in OpenCV's order. Raises OutputError."""
    path = folder / f"{stamp(timestamp_s)}.png"
    done, data = cv2.imencode(".png", image)
    if not done:
        raise OutputError(f"{path}: expected an image that PNG can hold, got shape {image.shape}")
    write_bytes(path, data.tobytes())


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def _run_lengths(states: Sequence[str]) -> list[list[Any]]:
    """["a", "a", "b"] to [["a", 2], ["b", 1]]."""
    runs: list[list[Any]] = []
    for state in states:
        if runs and runs[-1][0] == state:
            runs[-1][1] += 1
        else:
            runs.append([state, 1])
    return runs
