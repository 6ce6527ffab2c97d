"""What is read as a video, as images, and as files beside them."""

from __future__ import annotations

import io
import os
import random
import struct
from pathlib import Path

import numpy as np
from PIL import Image

import miniatures
from fuzz.case import Case, Room, kind
from fuzz.material import NAMES, Shared, garbled, garbled_text, nasty, npy_of, png_of, sparse
from helpers import blobs, write_video

SUFFIXES = ("mp4", "mkv", "avi", "mov", "webm", "gif", "m3u8", "sdp", "ts", "y4m", "jpg", "txt", "concat", "mpd", "svg")
HEADS = (
    *(("W64 H48", "30:1", "60000:1"), ("W64 H48", "30:1", "1:60000"), ("W64 H48", "1:1000000", "1:1")),
    *(("W64 H48", "1000000:1", "0:0"), ("W16000 H16000", "30:1", "1:1"), ("W2 H2", "0:0", "1:1")),
)
TEXTS = (
    "ffconcat version 1.0\nfile /etc/passwd\n",
    "#EXTM3U\n#EXTINF:10,\nfile:///etc/passwd\n",
    "v=0\nc=IN IP4 127.0.0.1\n",
    "YUV4MPEG2 W99999999 H99999999 F30:1\nFRAME\n",
    "<svg xmlns='http://www.w3.org/2000/svg' width='1e9'/>",
    "GIF89a" + "\xff" * 20,
    *(f"YUV4MPEG2 {size} F{rate} A{aspect} C420\nFRAME\n" + "\x80" * 9000 for size, rate, aspect in HEADS),
)
SIZES = ((2, 2), (4000, 20), (20, 4000), (16, 16), (8000, 8), (1000, 2), (64, 2))


def run_of(source: Path | str, room: Room, shared: Shared, *words: str | Path) -> Case:
    end = f"--end={1 if shared.quick else 3}"
    return Case(["run", source, "--out", room.out, "--no-map", "--quiet", end, *words])


@kind("videos", 70)
def videos(rng: random.Random, room: Room, shared: Shared) -> Case:
    path = room.given / f"v.{rng.choice(SUFFIXES)}"
    which = rng.randrange(5)
    if which == 0:
        nasty(rng, path, shared.video)
    elif which == 1:
        path.write_bytes(rng.choice(TEXTS).encode("latin-1"))
    elif which == 2:
        write_video(room.given / "v.mp4", blobs(3, *rng.choice(SIZES)), pix_fmt="yuv420p")
        path = room.given / "v.mp4"
    elif which == 3:
        data = bytearray(shared.video)
        at = data.find(rng.choice((b"tkhd", b"stsd", b"stts", b"stsz", b"mdhd", b"avc1", b"mvhd", b"ctts")))
        for _ in range(4):
            place = at + rng.randrange(4, 90)
            data[place : place + 4] = struct.pack(">I", rng.choice((0, 1, 2**31 - 1, 2**32 - 1, rng.randrange(2**32))))
        path.write_bytes(data)
    else:
        path.write_bytes(garbled(rng, shared.video))
    return run_of(path, room, shared)


@kind("image files", 80)
def image_files(rng: random.Random, room: Room, shared: Shared) -> Case:
    for n in range(3):
        good = rng.choice(shared.pictures) if rng.random() < 0.3 else shared.pictures[0]
        path = room.given / f"{n}.{rng.choice(('png', 'png', 'jpg', 'webp'))}"
        which = rng.randrange(8)
        if which == 0:
            nasty(rng, path, good)
        elif which == 1:
            size = rng.choice(
                ((65535, 65535), (13_000, 13_000), (2**31 - 1, 1), (1, 2**31 - 1), (0, 5), (50_000, 100), (1, 1))
            )
            path.write_bytes(
                png_of(*size, depth=rng.choice((1, 8, 16)), colour=rng.choice((0, 2, 3, 6)), data=b"\0" * 1000)
            )
        elif which == 2:
            path.write_bytes(_odd_image(rng))
        elif which == 3:
            path.write_bytes(garbled(rng, good))
        else:
            path.write_bytes(good)
    return run_of(room.given, room, shared)


def _odd_image(rng: random.Random) -> bytes:
    """Modes and sizes that files may have, and cameras do not."""
    mode = rng.choice(("1", "L", "P", "RGBA", "CMYK", "I;16", "F", "LA", "YCbCr"))
    size = rng.choice(((64, 48), (1, 1), (3, 2000), (64, 47), (5000, 5000)))
    buffer = io.BytesIO()
    suffix = {"CMYK": "JPEG", "YCbCr": "JPEG", "F": "TIFF"}.get(
        mode, rng.choice(("PNG", "PNG", "GIF" if mode == "P" else "PNG"))
    )
    Image.new(mode, size).save(buffer, suffix)
    return buffer.getvalue()


@kind("folders", 40)
def folders(rng: random.Random, room: Room, shared: Shared) -> Case:
    """Trees of odd entries."""
    at = room.given / "tree"
    at.mkdir()
    for n in range(rng.randrange(8)):
        name = rng.choice(
            (*NAMES, "rgb.txt", "depth.txt", "poses.txt", "calib.txt", "cam0", "image_2", "results", "traj.txt", "rgb")
        )
        place = rng.choice([p for p in (at, *at.rglob("*")) if p.is_dir() and not p.is_symlink()])
        path = place / f"{name.replace('/', '_')[:60]}{rng.choice(('', '.png', '.jpg', '.txt'))}"
        if path.exists() or path.is_symlink() or len(os.fsencode(path.name)) > 250:
            continue
        which = rng.randrange(4)
        if which == 0:
            nasty(rng, path, shared.pictures[0])
        elif which == 1:
            path.mkdir()
        elif which == 2:
            path.write_bytes(rng.choice(shared.pictures))
        else:
            path.symlink_to(rng.choice((".", "..", "../tree")))
    kinds = ("auto", "images", "tum", "bonn", "kitti-raw", "kitti-odometry", "7scenes", "euroc", "replica", "video")
    source = rng.choice(
        (at, at, at, "~nobody/x", "/dev/zero", "/dev/stdin", "/dev/null", "-", ".", "", "/proc/self/mem")
    )
    return run_of(source, room, shared, f"--kind={rng.choice(kinds)}")


@kind("datasets", 60)
def datasets(rng: random.Random, room: Room, shared: Shared) -> Case:
    """Miniatures of the public datasets with one or two files damaged."""
    make = rng.choice(
        (
            miniatures.kitti_raw,
            miniatures.kitti_odometry,
            miniatures.seven_scenes,
            miniatures.euroc,
            miniatures.replica,
            miniatures.bonn,
        )
    )
    made = make(room.given)
    files = sorted(p for p in room.given.rglob("*") if p.is_file())
    texts = [p for p in files if p.suffix not in (".png", ".jpg")]
    for path in rng.sample(texts, min(len(texts), rng.choice((1, 2)))) if rng.random() < 0.7 else [rng.choice(files)]:
        data = path.read_bytes()
        if path in texts and rng.random() < 0.7:
            path.write_text(garbled_text(rng, data.decode()), encoding="utf-8", errors="replace", newline="")
        else:
            nasty(rng, path, data)
    if rng.random() < 0.4:
        return Case(["run", made.folder, "--out", room.out, "--no-map", "--quiet", "--end=1"])
    return Case(["eval", "--trajectory", shared.run / "trajectory.txt", "--format=tum", made.folder])  # reads it all


def sequence(room: Room, count: int = 3) -> Path:
    """A folder in TUM's layout with everything that one can have."""
    folder = room.given / "seq"
    for name in ("rgb", "depth", "semantic", "mask"):
        (folder / name).mkdir(parents=True)
    images = blobs(count)
    rows: dict[str, list[str]] = {"rgb": [], "depth": [], "semantic": [], "mask": []}
    for n, image in enumerate(images):
        t = f"{1000 + n / 30:.6f}"
        Image.fromarray(image).save(folder / f"rgb/{t}.png")
        np.save(folder / f"depth/{t}.npy", np.full((48, 64), 2.0, np.float32))
        Image.new("L", (64, 48), 10).save(folder / f"semantic/{t}.png")
        Image.new("L", (64, 48)).save(folder / f"mask/{t}.png")
        for name, lines in rows.items():
            lines.append(f"{t} {name}/{t}.{'npy' if name == 'depth' else 'png'}\n")
    for name, lines in rows.items():
        (folder / f"{name}.txt").write_text("".join(lines))
    truth = [f"{1000 + n / 30:.6f} {0.1 * n:.3f} {0.02 * n * n:.3f} 0.0 0 0 0 1\n" for n in range(count)]
    (folder / "groundtruth.txt").write_text("# timestamp tx ty tz qx qy qz qw\n" + "".join(truth))
    info = '{"fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5, "width": 64, "height": 48, "depth_scale": 5000}'
    (folder / "info.json").write_text(info)
    return folder


@kind("lists and truth", 90)
def lists_and_truth(rng: random.Random, room: Room, shared: Shared) -> Case:
    """Text beside the frames: in a run, and in the scoring of another's trajectory."""
    folder = sequence(room, rng.choice((3, 8)))
    (room.given / "est.txt").write_text((folder / "groundtruth.txt").read_text())
    names = (
        "groundtruth.txt",
        "groundtruth.txt",
        "groundtruth.txt",
        "mask.txt",
        "rgb.txt",
        "depth.txt",
        "semantic.txt",
        "info.json",
    )
    for name in dict.fromkeys(rng.sample(names, rng.choice((1, 1, 2)))):  # what is spoilt once may be no text any more
        path = folder / name
        text = path.read_text()
        if rng.random() < 0.8:
            path.write_text(garbled_text(rng, text), encoding="utf-8", errors="replace", newline="")
        else:
            nasty(rng, path, text.encode())
    if rng.random() < 0.6:
        return Case(["eval", "--trajectory", room.given / "est.txt", "--format", "tum", folder])
    return run_of(folder, room, shared)


@kind("maps and depth", 60)
def maps_and_depth(rng: random.Random, room: Room, shared: Shared) -> Case:
    """Files of numbers: masks, probability maps, depth, true masks."""
    folder = sequence(room)
    where = rng.choice(("depth", "semantic", "mask", "maps"))
    (room.given / "maps").mkdir()
    at = room.given / "maps" if where == "maps" else folder / where
    for n in range(3):
        t = f"{1000 + n / 30:.6f}"
        path = at / f"{t}.{'npy' if where == 'depth' else rng.choice(('png', 'npy')) if where == 'maps' else 'png'}"
        if rng.random() < 0.3 and path.exists():
            continue
        _numbers_file(rng, path)
    words = ["--pointmaps=depth"] if where == "depth" else ["--maps", room.given / "maps"] if where == "maps" else []
    return run_of(folder, room, shared, *words)


def _numbers_file(rng: random.Random, path: Path) -> None:
    shape = rng.choice(((48, 64), (10**6, 10**6), (48, 64, 3), (0, 0), (48,), (), (2**40,), (1, 2**33)))
    dtype = rng.choice(("<f4", ">f8", "|O", "<i4", "<c8", "|S5", "<U4", "|b1", "<f2", "nonsense", "<u8"))
    bad = np.full((48, 64), float(rng.choice(("nan", "inf", "-1", "1e38", "2"))), np.float32)
    which = rng.randrange(6)
    if which == 0:
        nasty(rng, path, npy_of((48, 64), data=bad.tobytes()))
    elif which == 1:
        path.write_bytes(npy_of(shape, dtype, b"\0" * rng.choice((0, 100, 48 * 64 * 4))))
    elif which == 2:
        with open(path, "wb") as file:
            np.savez(file, a=bad)
    elif which == 3:
        path.write_bytes(npy_of(bad.shape, "<f4", bad.tobytes()))
    elif which == 4:
        path.write_bytes(png_of(*rng.choice(((65535, 65535), (2**31 - 1, 2), (64, 47), (13_000, 13_000))), colour=0))
    else:
        sparse(path, npy_of((1 << 30, 1), "<f4"))


@kind("foreign trajectories", 60)
def foreign_trajectories(rng: random.Random, room: Room, shared: Shared) -> Case:
    folder = sequence(room, 8)
    form = rng.choice(("tum", "kitti", "euroc"))
    pose = {
        "tum": "{t} 0.1 0.2 0.{n} 0 0 0 1",
        "kitti": "1 0 0 0.{n} 0 1 0 0.2 0 0 1 0.{n}",
        "euroc": "{t}000,0.1,0.2,0.{n},1,0,0,0",
    }
    rows = [
        pose[form].format(t=f"{1000 + n / 30:.6f}".replace(".", "." if form == "tum" else ""), n=n) for n in range(8)
    ]
    file = room.given / "est.txt"
    if rng.random() < 0.85:
        file.write_text(garbled_text(rng, "\n".join(rows)), encoding="utf-8", errors="replace", newline="")
    else:
        nasty(rng, file, "\n".join(rows).encode())
    out: list[str | Path] = [f"--out={room.out / rng.choice(('x.json', 'a/b', ''))}"] if rng.random() < 0.2 else []
    unlike = rng.choice(("tum", "kitti", "euroc")) if rng.random() < 0.15 else form
    return Case(["eval", "--trajectory", file, "--format", unlike, folder, *out])
