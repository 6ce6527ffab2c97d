"""Other systems' trajectories: round trips through three formats, scored as a run is, and files that are not one."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mastd3r.cli.main import main
from mastd3r.errors import ConfigError, InputError
from mastd3r.export.formats import kitti_text
from mastd3r.export.trajectory_files import read_trajectory, read_tum, write_tum
from mastd3r.geometry.quaternion import quaternion_from_rotation
from mastd3r.types import Trajectory

N = 24  # frames of the room clip


@pytest.fixture(scope="module")
def walk(room_clip: Path) -> Trajectory:
    """The room's true path with noise, at another scale and place."""
    true = read_tum(room_clip / "groundtruth.txt")
    rng = np.random.default_rng(0)
    poses = true.world_from_cam.copy()
    poses[:, :3, 3] = 3 * poses[:, :3, 3] + rng.normal(0, 0.01, (N, 3)) + 5
    noise = Rotation.from_rotvec(rng.normal(0, 0.01, (N, 3))).as_matrix()
    poses[:, :3, :3] = poses[:, :3, :3] @ noise
    return Trajectory(true.timestamps_s, poses, true.states, true.is_keyframe)


def written(path: Path, kind: str, walk: Trajectory) -> Path:
    """The walk as a file of another system."""
    if kind == "tum":
        write_tum(path, walk)
    elif kind == "kitti":
        path.write_text(kitti_text(walk))
    else:
        wxyz = quaternion_from_rotation(walk.world_from_cam[:, :3, :3])
        rows = zip(walk.timestamps_s, walk.world_from_cam[:, :3, 3], wxyz, strict=True)
        lines = [",".join([str(round(t * 1e9)), *(f"{v:.9f}" for v in (*p, *q)), "0.1", "0.2"]) for t, p, q in rows]
        path.write_text("#timestamp, p_x [m], p_y, p_z, q_w, q_x, q_y, q_z, v_x, v_y\n" + "\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("kind", ["tum", "kitti", "euroc"])
def test_poses_come_back(kind: str, walk: Trajectory, tmp_path: Path) -> None:
    back = read_trajectory(written(tmp_path / "t.txt", kind, walk), kind, walk.timestamps_s)
    np.testing.assert_allclose(back.timestamps_s, walk.timestamps_s, atol=6e-7)
    np.testing.assert_allclose(back.world_from_cam, walk.world_from_cam, atol=2e-8)


def test_every_format_gives_the_same_figures(walk: Trajectory, room_clip: Path, tmp_path: Path) -> None:
    figures = []
    for kind in ("tum", "kitti", "euroc"):
        file, out = written(tmp_path / kind, kind, walk), tmp_path / f"{kind}.json"
        words = ["eval", str(room_clip), "--trajectory", str(file), "--format", kind, "--out", str(out)]
        assert main(words) == 0
        figures.append(json.loads(out.read_text()))
    assert figures[0]["frames"] == figures[0]["frames_posed"] == N
    assert 0.001 < figures[0]["ate_rmse_all"] < 0.02 and figures[0]["rpe_rotation_frame_deg"] > 0.3
    for other in figures[1:]:
        assert other == pytest.approx(figures[0], rel=1e-5)


def test_keyframes_alone_are_scored_too(walk: Trajectory, room_clip: Path, tmp_path: Path) -> None:
    few = read_tum(written(tmp_path / "all.txt", "tum", walk))
    rows = (tmp_path / "all.txt").read_text().splitlines()
    (tmp_path / "few.txt").write_text("\n".join(rows[1::3]) + "\n")
    words = ["eval", str(room_clip), "--trajectory", str(tmp_path / "few.txt"), "--format", "tum"]
    assert main([*words, "--out", str(tmp_path / "f.json")]) == 0
    figures = json.loads((tmp_path / "f.json").read_text())
    assert (figures["frames"], figures["frames_posed"]) == (N, N // 3) and len(few.timestamps_s) == N


BAD = [
    ("tum", "1 2 3\n", "line 1: expected t tx ty tz qx qy qz qw"),
    ("tum", "1 2 3 x 0 0 0 1\n", "line 1: expected numbers"),
    ("tum", "0 0 0 0 0 0 0 0\n", "line 1: expected t tx"),
    ("tum", "# nothing\n", "expected poses, got none"),
    ("kitti", "1 0 0 0 0 1 0 0 0 0 1\n", "line 1: expected the 12 numbers of a KITTI pose, got 11"),
    ("kitti", "2 0 0 0 0 1 0 0 0 0 1 0\n", "line 1: expected a rotation and a position"),
    ("kitti", "nan 0 0 0 0 1 0 0 0 0 1 0\n", "line 1: expected a rotation and a position"),
    ("kitti", "1 0 0 0 0 1 0 0 0 0 1 0\n", "expected a row for each of the 24 frames"),
    ("euroc", "# t\n1 2 3 4 5 6 7 8\n", "line 2: expected numbers"),
    ("euroc", "1,2,3,4,1,0,0\n", "line 1: expected t_ns,x,y,z,qw,qx,qy,qz"),
    ("euroc", "1,2,3,4,0,0,0,0\n", "line 1: expected t_ns,x"),
]


@pytest.mark.parametrize(("kind", "text", "says"), BAD)
def test_files_that_are_not_of_their_kind(kind: str, text: str, says: str, walk: Trajectory, tmp_path: Path) -> None:
    (tmp_path / "t.txt").write_text(text)
    with pytest.raises(InputError, match=says):
        read_trajectory(tmp_path / "t.txt", kind, walk.timestamps_s)


def test_a_missing_file_and_an_unknown_kind(walk: Trajectory, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected a readable trajectory file"):
        read_trajectory(tmp_path / "none.txt", "kitti", walk.timestamps_s)
    with pytest.raises(ConfigError, match="expected one of tum, kitti, euroc, got 'bag'"):
        read_trajectory(tmp_path / "none.txt", "bag", walk.timestamps_s)  # type: ignore[arg-type]
    (tmp_path / "b.txt").write_bytes(b"\xff\xfe\x00rubbish")
    with pytest.raises(InputError, match="readable"):
        read_trajectory(tmp_path / "b.txt", "tum", walk.timestamps_s)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["eval", "CLIP"], "expected RUN SEQUENCE"),
        (["eval", "CLIP", "--format", "tum"], "--format or --out without it"),
        (["eval", "CLIP", "--trajectory", "FILE"], "--format tum, kitti or euroc and one SEQUENCE"),
        (["eval", "A", "CLIP", "--trajectory", "FILE", "--format", "tum"], "got 2 paths"),
        (["eval", "CLIP", "--trajectory", "FILE", "--format", "bag"], "'bag'"),
        (["eval", "BARE", "--trajectory", "FILE", "--format", "tum"], "expected a sequence with true poses"),
    ],
)
def test_words_that_do_not_fit(
    words: list[str], says: str, walk: Trajectory, room_clip: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    bare = tmp_path / "bare"
    bare.mkdir()
    (bare / "0.png").write_bytes(min((room_clip / "rgb").iterdir()).read_bytes())
    known = {"CLIP": room_clip, "FILE": written(tmp_path / "t.txt", "tum", walk), "BARE": bare}
    assert main([str(known.get(w, w)) for w in words]) == 2
    err = capfd.readouterr().err.splitlines()
    assert len(err) == 1 and says in err[0]
