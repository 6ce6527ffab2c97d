"""The browser viewer without a browser: what its scene holds, which picture it shows, and what it refuses."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import urllib.request
import webbrowser
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from helpers import blobs
from made_runs import edited_record, made_run
from mastd3r.camera.pinhole import Camera
from mastd3r.cli import view as command
from mastd3r.cli.main import main
from mastd3r.config import SourceConfig
from mastd3r.errors import ConfigError, InputError
from mastd3r.export.dense_files import write_dense_cloud
from mastd3r.export.mesh_files import read_mesh, write_mesh
from mastd3r.export.read_run import read_run
from mastd3r.export.video import write_video
from mastd3r.geometry.se3 import so3_exp
from mastd3r.live.browser import BrowserView
from mastd3r.mapping.gaussian_arrays import GaussianArrays
from mastd3r.mapping.ply import write_gaussians_ply
from mastd3r.sources import open_source
from mastd3r.types import State
from mastd3r.viewer.path import STATE_COLOURS, CameraPath, corner_rays, upright
from mastd3r.viewer.pictures import Pictures
from mastd3r.viewer.server import FIRST_PORT, LOOPBACK, free_port, is_installed, refused
from mastd3r.viewer.show_run import frames_of, read_content, show_run, typical_depth
from mastd3r.viewer.splat import splat_buffers

Array = NDArray[Any]
CAMERA = Camera(60.0, 58.0, 40.3, 28.7, 80, 60)
STATES: tuple[State, ...] = ("started", "tracked", "interpolated", "tracked", "tracked")
PLY = b"ply\nformat binary_little_endian 1.0\n"
needs_viser = pytest.mark.skipif(not is_installed(), reason="viser is not installed")


def gaussians(count: int = 50) -> GaussianArrays:
    rng = np.random.default_rng(4)
    quats = rng.normal(size=(count, 4)).astype(np.float32)
    return GaussianArrays(
        means=rng.normal(0, 1, (count, 3)).astype(np.float32),
        scales=rng.uniform(1e-4, 0.5, (count, 3)).astype(np.float32),
        quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
        opacities=rng.random(count).astype(np.float32),
        colors=rng.uniform(-0.1, 1.1, (count, 3)).astype(np.float32),
        kf_id=np.zeros(count, np.int32),
        sh_rest=np.zeros((count, 0, 3), np.float32),
    )


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """Five frames, the third interpolated; a cloud, no map."""
    return made_run(tmp_path, CAMERA, states=STATES).path


def with_map(run: Path) -> Path:
    write_gaussians_ply(run / "gaussians.ply", gaussians())
    edited_record(run, map={"median_depth": 5.0, "near": 1.0})
    return run


def at(x: float) -> Array:
    pose = np.eye(4)
    pose[0, 3] = x
    return pose


class Shown:
    """A scene that notes what it is given."""

    def __init__(self) -> None:
        self.frames: list[tuple[float, bool, State]] = []
        self.clouds, self.pictures, self.selected = 0, 0, -1

    @property
    def count(self) -> int:
        return len(self.frames)

    def add_frames(self, times_s: Any, poses: Any, states: Any) -> None:
        self.frames += [(t, p is not None, s) for t, p, s in zip(times_s, poses, states, strict=True)]

    def replace_frames(self, times_s: Any, poses: Any, states: Any) -> None:
        self.frames = []
        self.add_frames(times_s, poses, states)

    def set_cloud(self, layer: str, points_world: Array, colors: Array) -> None:
        assert layer == "sparse" and len(points_world) == len(colors) == 4
        self.clouds += 1

    def set_image(self, image: Array, mask: Array, text: str) -> None:
        assert mask.dtype == np.uint8 and mask.max() == 255
        self.pictures += 1

    def select(self, index: int) -> None:
        self.selected = index


def test_a_live_run_is_shown_whole_however_slow_the_browser_is() -> None:
    scene = Shown()
    view = BrowserView(scene)  # type: ignore[arg-type]
    for n in range(30):
        pose = None if n == 3 else at(0.1 * n)
        view.frame(SimpleNamespace(timestamp_s=n / 10, world_from_cam=pose, moving=np.eye(6), image=None, state="x"))  # type: ignore[arg-type]
        if n == 19:
            cloud = SimpleNamespace(points_world=np.zeros((4, 3)), colors=np.zeros((4, 3), np.uint8))
            view.cloud(cloud, np.arange(20) / 10, np.stack([at(0.2 * k) for k in range(20)]))  # type: ignore[arg-type]
    view.close()
    assert [t for t, _, _ in scene.frames] == [n / 10 for n in range(30)]
    assert scene.clouds == 1 and scene.pictures >= 1 and scene.selected == 29
    assert {s for _, _, s in scene.frames} == {"tracked"}  # the lost one has no place in the path of the map


def test_the_path_has_the_colours_of_its_states() -> None:
    path = CameraPath(corner_rays(CAMERA), 0.1)
    states: tuple[State, ...] = ("started", "tracked", "interpolated", "lost", "tracked")
    for n, state in enumerate(states):
        path.add(None if state == "lost" else at(n), state)
    points, colours = path.segments(0, 5)
    steps = {(float(a[0]), float(b[0])): tuple(c[0]) for (a, b), c in zip(points, colours, strict=True)}
    assert {k: v for k, v in steps.items() if abs(k[0] - k[1]) >= 1} == {
        (0, 1): STATE_COLOURS["tracked"],
        (1, 2): STATE_COLOURS["interpolated"],
        (2, 4): STATE_COLOURS["lost"],  # the bridge over what has no pose
    }
    assert len(points) == 4 * 8 + 3 and path.pose(3) is None and len(path.selected(3)) == 0
    assert np.allclose(path.selected(1)[:4, 0], [1, 0, 0])
    again = [path.segments(0, 2), path.segments(2, 5)]
    assert np.array_equal(np.concatenate([p for p, _ in again]), points)


def test_frusta_that_the_eye_cannot_tell_apart_are_left_out() -> None:
    path = CameraPath(corner_rays(None), 1.0)
    for n in range(100):
        path.add(at(0.1 * n), "tracked")
    assert len(path.segments(0, 100)[0]) == 99 + 8 * 7  # one every 1.6 of 9.9


def test_frustum_corners_are_the_corners_of_the_image() -> None:
    pixels = CAMERA.project(corner_rays(CAMERA))
    assert np.allclose(pixels, [[-0.5, -0.5], [79.5, -0.5], [79.5, 59.5], [-0.5, 59.5]])


def test_the_up_direction_gives_the_camera_its_own_roll_back() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        pose = np.eye(4)
        pose[:3, :3] = so3_exp(rng.normal(0, 0.8, 3))
        up, forward = upright(pose), pose[:3, 2]
        right = np.cross(forward, up)
        assert np.allclose(right / np.linalg.norm(right), pose[:3, 0])
    assert np.allclose(upright(np.eye(4)), [0, -1, 0])


def test_covariances_keep_their_digits_in_half_floats() -> None:
    given = gaussians()
    buffers = splat_buffers(given)
    sent = buffers.covariances.astype(np.float16).astype(float) * buffers.scale**2
    assert np.allclose(np.linalg.eigvalsh(sent)[:, 2], np.sort(given.scales)[:, 2] ** 2, rtol=2e-3)
    thin = splat_buffers(replace(given, scales=np.full((50, 3), 1e-4, np.float32)))
    assert np.allclose(thin.covariances.astype(np.float16).astype(float) * thin.scale**2, 1e-8 * np.eye(3), atol=1e-11)
    assert np.allclose(buffers.centers * buffers.scale, given.means, atol=1e-5)
    assert buffers.colours.min() == 0 and buffers.colours.max() == 255 and buffers.left_out == 0
    assert len(splat_buffers(gaussians(0)).centers) == 0
    broken = replace(given, means=np.where(np.arange(50)[:, None] == 7, np.nan, given.means))
    assert splat_buffers(broken).left_out == 1 and len(splat_buffers(broken).centers) == 49


def test_frames_without_a_pose_are_there_too(run: Path) -> None:
    (run / "states.txt").open("a").write("100.5 lost\n")
    frames = frames_of(read_run(run))
    assert [s for _, _, s in frames] == [*STATES, "lost"] and frames[-1][:2] == (100.5, None)
    (run / "states.txt").write_text("100.0 found\n")
    with pytest.raises(InputError, match="expected a time and a state"):
        frames_of(read_run(run))


def test_a_run_without_a_map_says_so(run: Path) -> None:
    content = read_content(run)
    assert content.splat is None and content.sparse is not None and len(content.sparse[0]) == 60
    assert 4 < typical_depth(content) < 6
    assert any("no gaussians.ply" in line for line in content.notices)
    assert not any("gaussians.ply" in line for line in read_content(with_map(run)).notices)


def test_pictures_come_from_the_photographs_while_they_are_there(run: Path) -> None:
    images = blobs(5, CAMERA.width, CAMERA.height)
    times = [t for t, _, _ in frames_of(read_run(run))]
    picture = Pictures(read_run(run)).at(times[3])
    assert picture.image is not None and picture.mask is not None and picture.said == "photograph"
    assert np.abs(picture.image.astype(float) - images[3]).mean() < 5  # png of another size would be far off
    assert picture.mask[12, 20] == 255
    source = Path(read_run(run).record["source"]["path"])
    source.rename(source.with_name("moved"))
    picture = Pictures(read_run(run)).at(times[3])
    assert picture.image is None and picture.mask is not None and "no such path" in picture.said
    write_video(run / "masks.mp4", images, 30)
    picture = Pictures(read_run(run)).at(times[3])
    assert picture.image is not None and "masks.mp4" in picture.said and "no such path" in picture.said
    assert np.argmin([np.abs(picture.image.astype(float) - image).mean() for image in images]) == 3
    (run / "masks.mp4").write_bytes(b"no video")
    assert "no such path" in Pictures(read_run(run)).at(times[3]).said
    (run / "masks.mp4").unlink()
    edited_record(run, source=None)
    assert Pictures(read_run(run)).at(0.123).said


def test_a_frame_of_a_video_is_found_by_its_time(tmp_path: Path) -> None:
    images = [np.full((48, 64, 3), 40 + 10 * n, np.uint8) for n in range(20)]
    write_video(tmp_path / "v.mp4", images, 10)
    source = open_source(tmp_path / "v.mp4", SourceConfig(start=2))
    for n in (13, 0, 19, 7):
        image = source.image_at(n / 10)  # type: ignore[attr-defined]
        assert abs(float(image.mean()) - (40 + 10 * n)) < 3


def test_meshes_are_read_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    places, faces = rng.normal(size=(6, 3)).astype(np.float32), np.array([[0, 1, 2], [3, 4, 5]], np.int32)
    colors = rng.integers(0, 256, (6, 3)).astype(np.uint8)
    write_mesh(tmp_path / "m.ply", places, faces, colors)
    for ours, back in zip((places, faces, colors), read_mesh(tmp_path / "m.ply"), strict=True):
        assert np.array_equal(ours, back)
    whole = (tmp_path / "m.ply").read_bytes()
    for damaged in (whole[:-3], whole.replace(b"uchar int", b"uchar float"), whole[:-4] + b"\xff\xff\xff\x7f"):
        (tmp_path / "m.ply").write_bytes(damaged)
        with pytest.raises(InputError, match="expected"):
            read_mesh(tmp_path / "m.ply")


@needs_viser
def test_the_scene_holds_what_the_run_has(run: Path, tmp_path: Path) -> None:
    with_map(run)
    points = np.random.default_rng(0).normal(size=(9, 3)).astype(np.float32)
    colors = np.full((9, 3), 77, np.uint8)
    write_dense_cloud(tmp_path / "d.ply", points, points, colors, np.ones(9))
    write_mesh(tmp_path / "m.glb", points, np.array([[0, 1, 2]], np.int32), colors)
    with show_run(run, files=[tmp_path / "d.ply", tmp_path / "m.glb"]) as viewer:
        server = viewer.scene._server
        known = server.scene.get_handle_by_name
        shown = {name: known(f"/{name}").visible for name in ("splat", "dense", "mesh", "sparse", "path")}
        assert shown == {"splat": True, "dense": False, "mesh": False, "sparse": False, "path": True}
        assert np.array_equal(known("/dense/points").points, points) and len(known("/sparse/points").points) == 60
        assert known("/path/0") is not None and known("/path/selected") is not None and known("/path/1") is None
        first = frames_of(read_run(run))[0][1]
        assert first is not None and np.allclose(server.initial_camera.position, first[:3, 3])
        looks = server.initial_camera.look_at - server.initial_camera.position
        assert np.allclose(looks / np.linalg.norm(looks), first[:3, 2])
        assert viewer.scene.selected == 0 and not viewer.scene.panel.jump.disabled
        viewer.scene.select(2)
        assert viewer.scene.panel.frame.value == 2 and "interpolated" in viewer.scene.panel._about_frame.content
        assert viewer.scene.panel._about_image.content == "photograph"
        viewer.scene.panel.point_size.value = 2.0
        assert known("/sparse/points").point_size == pytest.approx(0.01)
        page = urllib.request.urlopen(viewer.address, timeout=10).read()
        assert b"<html" in page and viewer.address.startswith(f"http://{LOOPBACK}:")


@needs_viser
def test_a_scene_grows_frame_by_frame(run: Path) -> None:
    edited_record(run, source=None)
    with show_run(run) as viewer:
        scene = viewer.scene
        seen: list[int] = []
        scene.on_select(seen.append)
        for n in range(5, 130):
            scene.add_frame(100 + n / 30, at(0.1 * n), "tracked")
        assert scene.panel.frame.max == 129 and scene._server.scene.get_handle_by_name("/path/2") is not None
        scene.select(129)
        assert seen == [129]
        scene.set_image(np.zeros((6, 8, 3), np.uint8), np.full((3, 4), 255, np.uint8), "live")
        assert scene.panel._image.image.max() > 90  # the mask over it
        scene.panel.masked.value = False
        assert scene.panel._image.image.max() == 0
        scene.replace_frames([0.0, 1.0], [None, at(1)], ["lost", "tracked"])
        assert scene.selected == 1 and scene._server.scene.get_handle_by_name("/path/2") is None


def test_without_the_extra_the_report_opens(
    run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(command, "is_installed", lambda: False)
    opened: list[str] = []
    monkeypatch.setattr(command, "_browse", lambda address: opened.append(address) is None)
    assert main(["view", str(run)]) == 2 and "expected the report" in capsys.readouterr().err
    (run / "report.html").write_text("<html></html>")
    assert main(["view", str(run)]) == 0 and opened == [(run / "report.html").resolve().as_uri()]
    assert "pip install 'mastd3r-slam[view]'" in capsys.readouterr().out
    monkeypatch.setattr(command, "_browse", lambda address: False)
    assert main(["view", str(run), "--report"]) == 0 and "no browser found" in capsys.readouterr().out


def test_a_browser_for_terminals_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(webbrowser, "get", lambda: webbrowser.GenericBrowser("lynx"))
    assert not command._browse("http://127.0.0.1:1")

    def none() -> None:
        raise webbrowser.Error("could not locate runnable browser")

    monkeypatch.setattr(webbrowser, "get", none)
    assert not command._browse("http://127.0.0.1:1")


@needs_viser
@pytest.mark.parametrize(
    ("file", "content", "expected"),
    [
        ("run.json", b"{", "expected readable JSON"),
        ("run.json", None, "expected a run folder"),
        ("run.json", b'{"states": 7}', "states: expected pairs"),
        ("gaussians.ply", PLY + b"element vertex x\nend_header\n", "elements and properties"),
        ("gaussians.ply", PLY + b"element vertex 0\nproperty float x\nend_header\n", "3-D Gaussian .ply"),
        ("cloud.ply", PLY + b"element vertex 5\nproperty float x\nend_header\n", "bytes"),
        ("cloud.ply", PLY + b"element\nend_header\n", "elements and properties"),
        ("mesh.glb", b"glTF\2\0\0\0\xff\0\0\0", "whole .glb"),
        ("states.txt", b"\xff\xfe", "readable trajectory"),
    ],
)
def test_damaged_files_are_one_line(
    run: Path, file: str, content: bytes | None, expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (run / file).unlink(missing_ok=True)
    if content is not None:
        (run / file).write_bytes(content)
    assert main(["view", str(run), "--no-browser"]) == 2
    said = capsys.readouterr().err
    assert expected in said and len(said.splitlines()) == 1


@needs_viser
def test_addresses_that_cannot_be_served_on_are_one_line(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server((LOOPBACK, 0)) as taken:
        port = taken.getsockname()[1]
        assert main(["view", str(run), "--no-browser", "--port", str(port)]) == 2
        assert f"--port {port}: expected an address to serve on, got" in capsys.readouterr().err
    assert main(["view", str(run), "--no-browser", "--host", "203.0.113.7"]) == 2
    assert "--host 203.0.113.7: expected a free port" in capsys.readouterr().err
    for port_word in ("0", "70000", "http"):
        assert main(["view", str(run), "--port", port_word]) == 2
        assert "expected a number from 1 to 65535" in capsys.readouterr().err


def test_a_free_port_is_looked_for() -> None:
    first = free_port(LOOPBACK)
    with socket.create_server((LOOPBACK, first)):
        assert refused(LOOPBACK, first) is not None
        assert FIRST_PORT <= free_port(LOOPBACK) != first


@needs_viser
def test_ctrl_c_ends_it_cleanly(run: Path) -> None:
    words = [sys.executable, "-m", "mastd3r", "view", str(run), "--no-browser"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stderr is not None
        assert process.stdout.readline().startswith("http://127.0.0.1:")
        process.send_signal(signal.SIGINT)
        rest, said = process.communicate(timeout=30)
    assert process.returncode == 130 and rest == ""
    assert said.splitlines()[-1] == "mastd3r: stopped; the run is as it was"
    assert "Traceback" not in said


def test_a_name_that_is_not_known_is_asked_for_once(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def unknown(host: str, *_: Any, **__: Any) -> Any:
        asked.append(host)
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    with pytest.raises(ConfigError, match="--host con: expected the name or address of this machine, got name or serv"):
        free_port("con")
    assert asked == ["con"]


@pytest.mark.parametrize("host", ["x\x9by", "a" * 70, "..", "\ud800"])
def test_a_name_that_no_host_can_have_is_refused(host: str) -> None:
    assert refused(host, FIRST_PORT) == "a name that no host can have"
