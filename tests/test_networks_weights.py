"""Weights are where they are said to be, are what was released, and come there by every way that a user has."""

from __future__ import annotations

import argparse
import hashlib
import json
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from local_server import FileServer, file_server
from mastd3r.cli import weights as cli_weights
from mastd3r.download.fetch import Interrupted
from mastd3r.download.weights import absent, check, entries, folder_of, home, installed, path
from mastd3r.download.weights_download import download
from mastd3r.download.weights_known import DEFAULT_DINOV2, KNOWN, KnownFile, Licence
from mastd3r.errors import ConfigError, InputError, SlamError

TENSORS, PICKLE, SMALL = (np.random.default_rng(seed).bytes(400_000) for seed in range(3))
CONFIG = b'{"model_type": "dinov2_with_registers"}'
DINO = "dinov2-with-registers-small"
MAST3R_ID = KNOWN["mast3r"].origins[0].hub_id
PTH = KNOWN["mast3r"].origins[1].files[0].name


def sha(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def listing(files: dict[str, bytes], *, sums: bool = True) -> bytes:
    """What the hub answers to /api/models/ID/revision/REV?blobs=true."""
    rows: list[dict[str, Any]] = []
    for name, data in files.items():
        row: dict[str, Any] = {"rfilename": name, "size": len(data), "blobId": "x"}
        if name.endswith((".safetensors", ".pth")) and sums:
            row["lfs"] = {"sha256": sha(data), "size": len(data), "pointerSize": 134}
        rows.append(row)
    return json.dumps({"id": "x/y", "sha": "z", "siblings": rows}).encode()


def publish(server: FileServer, hub_id: str, files: dict[str, bytes], revision: str = "main") -> None:
    server.files[f"/api/models/{hub_id}/revision/{revision}?blobs=true"] = listing(files)
    server.files.update({f"/{hub_id}/resolve/{revision}/{name}": data for name, data in files.items()})


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[FileServer]:
    """A hub and a second origin with small files under the released names, and an empty MASTD3R_HOME."""
    monkeypatch.setenv("MASTD3R_HOME", str(tmp_path / "home"))
    with file_server() as state:
        monkeypatch.setenv("HF_ENDPOINT", state.url)
        real, dino = KNOWN["mast3r"], KNOWN[DINO]
        hub = replace(real.origins[0], files=(KnownFile("model.safetensors", len(TENSORS), sha(TENSORS)),))
        other = replace(
            real.origins[1], files=(KnownFile(PTH, len(PICKLE), sha(PICKLE)),), folder_url=state.url + "/naver"
        )
        monkeypatch.setitem(KNOWN, "mast3r", replace(real, origins=(hub, other)))
        publish(state, hub.hub_id, {"model.safetensors": TENSORS, "config.json": b"{}"}, hub.revision)
        state.files[f"/naver/{PTH}"] = PICKLE
        publish(
            state, f"facebook/{DINO}", {"config.json": CONFIG, "model.safetensors": SMALL}, dino.origins[0].revision
        )
        yield state


def yes(licence: Licence) -> bool:
    return True


def never(licence: Licence) -> bool:
    raise AssertionError("asked for a licence")


def test_the_registry_is_sound() -> None:
    assert DEFAULT_DINOV2 in KNOWN and len(KNOWN) == 7
    for name, known in KNOWN.items():
        assert known.name == name and known.licence.text and known.origins
        for origin in known.origins:
            assert bool(origin.hub_id) != bool(origin.folder_url)
            assert not origin.hub_id or re.fullmatch(r"[0-9a-f]{40}", origin.revision)
            for file in origin.files:
                assert file.sha256 is None or re.fullmatch(r"[0-9a-f]{64}", file.sha256)
                assert (file.sha256 is None) == (file.size_bytes is None)
    mast3r = KNOWN["mast3r"]
    parameters = 688_638_856
    assert all(0 < f.size_bytes - 4 * parameters < 500_000 for o in mast3r.origins for f in o.files if f.size_bytes)
    assert mast3r.licence.title == "CC BY-NC-SA 4.0" and "no commercial use" in mast3r.licence.text
    assert mast3r.origins[0].page.endswith("/naver/MASt3R_ViTLarge_BaseDecoder_512_catmlpdpt_metric")


def test_home_follows_the_variable_else_the_platform(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("MASTD3R_HOME", str(tmp_path / "x"))
    assert home() == tmp_path / "x" and folder_of("a") == tmp_path / "x" / "weights" / "a"
    monkeypatch.delenv("MASTD3R_HOME")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for platform, ending in (("linux", "cache/mastd3r"), ("darwin", "Library/Caches/mastd3r")):
        monkeypatch.setattr("sys.platform", platform)
        assert home().as_posix().endswith(ending)
    monkeypatch.setattr("sys.platform", "win32")
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path / "local"))
    assert home() == tmp_path / "local" / "mastd3r"


def test_by_name_the_licence_is_shown_once_and_the_checksum_recorded(server: FileServer) -> None:
    shown: list[Licence] = []
    assert not installed("mast3r")
    with pytest.raises(ConfigError, match="not accepted, nothing was fetched"):
        download("mast3r", lambda licence: bool(shown.append(licence)))
    assert not server.seen and not folder_of("mast3r").exists()
    got = download("mast3r", lambda licence: shown.append(licence) is None)
    assert got == path("mast3r") == path(MAST3R_ID) == folder_of("mast3r") / "model.safetensors"
    assert got.read_bytes() == TENSORS and installed("mast3r") and [x.key for x in shown] == ["mast3r"] * 2
    record = json.loads((got.parent / "weights.json").read_text())
    assert record["files"] == {"model.safetensors": {"bytes": len(TENSORS), "sha256": sha(TENSORS)}}
    assert record["origin"] == f"{server.url}/{MAST3R_ID}"
    before = len(server.seen)
    assert download(MAST3R_ID, never) == got and len(server.seen) == before, "what is there is not fetched again"
    got.unlink()
    assert download("mast3r", never) == got, "the licence was shown already"


def test_an_interrupted_download_is_resumed_by_the_same_command(server: FileServer) -> None:
    server.drop_always = 0.4
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("time.sleep", lambda s: None)
        with pytest.raises(Interrupted, match="the same command again"):
            download("mast3r", yes)
    assert not installed("mast3r") and entries()[0].state == "incomplete"
    server.drop_always, server.sent_bytes = None, 0
    assert download("mast3r", never).read_bytes() == TENSORS
    assert server.sent_bytes == len(TENSORS) - int(0.4 * len(TENSORS))


def test_the_second_origin_serves_where_the_first_does_not_answer(
    server: FileServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HF_ENDPOINT", "http://127.0.0.1:9")
    got = download("mast3r", yes)
    assert got.name == PTH and got.read_bytes() == PICKLE and check("mast3r")[0].right


def test_offline_says_what_to_place_where_and_that_is_enough(
    server: FileServer, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("HF_ENDPOINT", "http://127.0.0.1:9")
    known = KNOWN["mast3r"]
    monkeypatch.setitem(
        KNOWN, "mast3r", replace(known, origins=(known.origins[0], replace(known.origins[1], folder_url="http://127.0.0.1:9")))
    )  # fmt: skip
    with pytest.raises(InputError) as told:
        download("mast3r", yes)
    folder = folder_of("mast3r")
    place = rf"; without a network, place model.safetensors \(400 kB\) from .*/{MAST3R_ID} in {folder}$"
    assert re.search(f"cannot be reached .*{place}", str(told.value))
    with pytest.raises(InputError, match=r"run mastd3r weights download mast3r, or place model.safetensors"):
        path("mast3r")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "model.safetensors").write_bytes(TENSORS[:-7])
    with pytest.raises(InputError, match=r"got model\.safetensors of 399993 bytes instead of 400000"):
        path("mast3r")
    (folder / "model.safetensors").write_bytes(TENSORS)
    assert path("mast3r") == folder / "model.safetensors"
    (checked,) = check("mast3r")
    assert checked.right and checked.recorded and not check("mast3r")[0].recorded
    assert download("mast3r", never) == path("mast3r")


def test_the_released_pickle_placed_by_hand_counts(server: FileServer) -> None:
    folder_of("mast3r").mkdir(parents=True)
    (folder_of("mast3r") / PTH).write_bytes(PICKLE)
    assert path("mast3r").name == PTH and check("mast3r")[0].right
    (folder_of("mast3r") / PTH).write_bytes(TENSORS)  # the right size, other bytes
    assert not check("mast3r")[0].right


def test_dinov2_without_a_released_checksum_is_held_to_the_hubs(server: FileServer) -> None:
    got = download(DINO, yes)
    assert got == folder_of(DINO) == path(f"facebook/{DINO}")
    assert (got / "config.json").read_bytes() == CONFIG and (got / "model.safetensors").read_bytes() == SMALL
    assert sorted(p.name for p in got.iterdir()) == ["config.json", "model.safetensors", "weights.json"]
    revision = KNOWN[DINO].origins[0].revision
    server.files[f"/facebook/{DINO}/resolve/{revision}/model.safetensors"] = TENSORS  # another file of the same size
    (got / "model.safetensors").unlink()
    with pytest.raises(InputError, match=f"expected sha256 {sha(SMALL)}, got {sha(TENSORS)}"):
        download(DINO, never)
    assert not installed(DINO) and not (got / "model.safetensors.part").exists()


def test_a_changed_file_is_found_by_check(server: FileServer) -> None:
    folder = download(DINO, yes)
    assert [c.right for c in check(DINO)] == [True, True] and [c.expected for c in check(DINO)][1] == sha(SMALL)
    (folder / "model.safetensors").write_bytes(TENSORS)
    assert [(c.path.name, c.right) for c in check(DINO)] == [("config.json", True), ("model.safetensors", False)]
    assert download(DINO, never) == folder and all(c.right for c in check(DINO)), "fetched again, as it was wrong"


def test_any_hub_id_goes_by_its_own_name(server: FileServer) -> None:
    publish(server, "someone/fine_tuned", {
        "README.md": b"text", "config.json": CONFIG, "model.safetensors": SMALL, "sub/model.safetensors": TENSORS,
    })  # fmt: skip
    got = download("someone/fine_tuned", never)
    assert got == folder_of("someone--fine_tuned") == path("someone/fine_tuned")
    assert {p.name for p in got.iterdir()} == {"config.json", "model.safetensors", "weights.json"}
    assert download("someone/fine_tuned", never, as_name="mine") == path("mine")
    assert [e.name for e in entries()[len(KNOWN):]] == ["mine", "someone--fine_tuned"]  # fmt: skip
    publish(server, "someone/pickled", {"weights.pth": PICKLE})
    assert download("someone/pickled", never).name == "weights.pth"
    publish(server, "someone/empty", {"README.md": b"text"})
    with pytest.raises(InputError, match=r"someone/empty: expected weights"):
        download("someone/empty", never)
    with pytest.raises(InputError, match="HTTP 404"):
        download("someone/absent", never)
    server.files["/api/models/someone/odd/revision/main?blobs=true"] = b"<html>"
    with pytest.raises(InputError, match="expected a list of files"):
        download("someone/odd", never)


def test_a_url_is_known_by_its_file_name_or_by_as(server: FileServer) -> None:
    server.files[f"/naver/{PTH}?download=true"] = PICKLE
    got = download(f"{server.url}/naver/{PTH}?download=true", yes)
    assert got == folder_of("mast3r") / PTH
    server.files["/x/tuned.safetensors"] = SMALL
    assert download(f"{server.url}/x/tuned.safetensors", never) == folder_of("tuned") / "tuned.safetensors"
    server.files["/x/model.safetensors"] = SMALL
    with pytest.raises(ConfigError, match="expected a name for these weights, for instance --as mast3r"):
        download(f"{server.url}/x/model.safetensors", never)
    with pytest.raises(InputError, match=r"expected 400000 bytes|expected sha256"):
        download(f"{server.url}/x/model.safetensors", never, as_name="mast3r")
    assert path("mast3r").read_bytes() == PICKLE, "what was there stays when another file is refused"


def test_another_form_of_the_same_weights_replaces_the_first(server: FileServer) -> None:
    first = download("mast3r", yes)
    second = download(f"{server.url}/naver/{PTH}", yes)
    assert second == path("mast3r") and second.name == PTH and not first.exists()
    assert len(check("mast3r")) == 1


def test_local_files_and_folders_are_copied_and_held_to_the_release(server: FileServer, tmp_path: Path) -> None:
    stick = tmp_path / "stick"
    (stick / DINO).mkdir(parents=True)
    (stick / "renamed.pth").write_bytes(PICKLE)
    assert download(str(stick / "renamed.pth"), yes, as_name="mast3r") == folder_of("mast3r") / PTH
    (stick / PTH).write_bytes(PICKLE[:-1] + b"x")
    (folder_of("mast3r") / PTH).unlink()
    with pytest.raises(InputError, match="expected sha256"):
        download(str(stick / PTH), yes)
    (stick / DINO / "config.json").write_bytes(CONFIG)
    with pytest.raises(InputError, match="expected a file, got no such file"):
        download(str(stick / DINO), yes)
    (stick / DINO / "model.safetensors").write_bytes(SMALL)
    assert download(str(stick / DINO), yes) == folder_of(DINO) and installed(DINO)
    with pytest.raises(ConfigError, match=r"expected a folder with config\.json and model\.safetensors"):
        download(str(stick / DINO / "model.safetensors"), yes, as_name=DINO)
    with pytest.raises(ConfigError, match="expected a file that ends in"):
        download(str(stick / DINO / "config.json"), yes, as_name="other")
    assert download(str(stick / DINO), yes, as_name="copy") == folder_of("copy")
    assert len(server.seen) == 0
    assert path(str(stick / DINO)) == stick / DINO and [c.expected for c in check(str(stick / PTH))] == [sha(PICKLE)]


@pytest.mark.parametrize("what", ["mast3rr", "no such thing", "a/b/c", "../x", "x.pth"])
def test_what_is_no_weights_is_one_line(server: FileServer, what: str) -> None:
    for act in (lambda: download(what, never), lambda: path(what), lambda: check(what)):
        with pytest.raises(SlamError) as told:
            act()  # type: ignore[no-untyped-call]
        assert str(told.value).startswith(what) and "\n" not in str(told.value)
    with pytest.raises(ConfigError, match="--as"):
        download("mast3r", never, as_name="../outside")
    with pytest.raises(ConfigError, match="expected no --as"):
        download("mast3r", never, as_name="other")
    assert not home().joinpath("outside").exists() and "mastd3r weights list" in absent("unknown")


def test_a_damaged_record_is_said(server: FileServer) -> None:
    folder = download("mast3r", yes).parent
    for text in ("{", "[]", '{"files": 3}'):
        (folder / "weights.json").write_text(text)
        with pytest.raises(InputError, match=r"weights.json: expected .*; remove it"):
            path("mast3r")


Command = Callable[..., tuple[int, str, str]]


@pytest.fixture
def weights(server: FileServer, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Command:
    """``mastd3r weights …`` as the command line calls it: (exit code, stdout, stderr)."""
    monkeypatch.setenv("COLUMNS", "300")

    def run(*words: str) -> tuple[int, str, str]:
        parser = argparse.ArgumentParser()
        cli_weights.weights_parser(parser)
        args = parser.parse_args(words)
        code = args.act(args, Console(stderr=True, force_terminal=True))
        said = capsys.readouterr()
        return code, said.out, said.err

    return run


def test_the_command_lists_downloads_checks_and_prints_paths(weights: Command) -> None:
    code, out, _ = weights("list")
    assert code == 0 and all(name in out for name in KNOWN) and "CC BY-NC-SA 4.0" in out and str(home()) in out
    assert not re.search("installed", out)
    with pytest.raises(ConfigError, match="no terminal; --yes accepts it"):
        weights("download", "mast3r")
    code, out, err = weights("download", "mast3r", "--yes")
    assert code == 0 and "no commercial use" in err and f"ready: {path('mast3r')}" in out
    assert "400/400" in re.sub(r"\s", "", err), "the bar counts kB"
    code, out, err = weights("download", "mast3r", "--quiet")
    assert "no commercial use" not in err
    assert weights("path", "mast3r")[1] == f"{path('mast3r')}\n"
    code, out, _ = weights("check")
    assert code == 0 and "right" in out and sha(TENSORS)[:12] in out
    assert re.search(r"mast3r\s*│\s*installed", weights("list")[1])
    path("mast3r").write_bytes(SMALL)
    with pytest.raises(InputError, match="expected the checksum of its release"):
        weights("check", "mast3r")


def test_the_command_asks_on_a_terminal(weights: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    monkeypatch.setattr("builtins.input", lambda *prompt: "n")
    with pytest.raises(ConfigError, match="not accepted"):
        weights("download", "mast3r")
    monkeypatch.setattr("builtins.input", lambda *prompt: "Yes")
    assert weights("download", "mast3r")[0] == 0


def test_the_command_says_where_a_licence_is_not_known(server: FileServer, weights: Command) -> None:
    publish(server, "someone/other", {"model.safetensors": SMALL})
    assert "licence of these weights is not known" in weights("download", "someone/other")[2]
    assert weights("check")[1].count("right") == 1
