"""Words of the command line: options, YAML, names, places to write."""

from __future__ import annotations

import os
import random
import shutil
from pathlib import Path

from fuzz.case import Case, Room, kind
from fuzz.material import NAMES, NUMBERS, Shared, garbled, nasty, sparse
from mastd3r.config import Config, config_to_yaml, ranges

COMMANDS = (
    "run",
    "resume",
    "map",
    "demo",
    "eval",
    "export",
    "view",
    "bench",
    "weights",
    "download",
    "doctor",
    "live",
    "finish",
    "batch",
    "save",
    "localise",
    "scale",
)
OPTIONS = (
    *("--seed", "--start", "--end", "--stride", "--map-minutes", "--intrinsics", "--quality", "--kind", "--preset"),
    *("--cloud", "--masks", "--semantics", "--correction", "--map-loss", "--scale", "--segment-frames", "--jobs"),
    *("--memory-mib", "--retries", "--task-cores", "--task-gpus"),
)
WINDOW = ("start", "end", "stride", "intrinsics", "kind")
YAML = (
    "!!int 'x'",
    "!!python/object/apply:os.system ['true']",
    "2024-13-45",
    "2024-01-01",
    "&a [*a]",
    "[" * 5000,
    "{a: " * 3000,
    "!!binary '###'",
    "!!timestamp x",
    "? [a]\n: b",
    "*nothing",
    "9" * 400,
    "1e999",
    ".nan",
    "\x00",
    "'\\ud800'",
    "!!set {a}",
    "<<: 1",
    "[1, 2",
    "{a: 1, a: 2}",
    "0b2",
    "190:20:30",
    "\ufeff1",
    "- - - 1",
    "%TAG",
)
LAUGHS = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{chr(98 + n)}: &{chr(98 + n)} [{','.join(['*' + chr(97 + n)] * 9)}]\n" for n in range(9)
)


def short_run(room: Room, shared: Shared, *words: str | Path) -> list[str | Path]:
    """A run that ends by itself at once, if it is not refused before: one image is too little."""
    return ["run", shared.one_image, "--out", room.out, "--no-map", "--quiet", *words]


@kind("metric scale", 40)
def metric_scale(rng: random.Random, room: Room, shared: Shared) -> Case:
    """What metres are taken from: words, files of positions, folders of depth; for a run, and on one that has ended."""
    number, file = rng.choice(NUMBERS), room.path / "positions.csv"
    head = rng.choice(("", "time,x,y,z\n", "t,lat,lon,alt\n", "#timestamp [ns],,\n", "time\n", '"time","x","y","z"\n'))
    rows = [",".join(rng.choice((number, "1", "0.5", str(n))) for _ in range(rng.choice((2, 4, 8)))) for n in range(9)]
    text = (head + "\n".join(rows)).encode()
    file.write_bytes(garbled(rng, text) if rng.random() < 0.5 else text)
    words = rng.choice(
        (
            f"positions:{file}",
            f"positions:{file}",
            f"positions:{rng.choice(NAMES)}",
            f"depth:{shared.run.parent / 'photos'}={number}",
            f"depth:{shared.run / rng.choice(('masks', 'renders', '.'))}={rng.choice((number, '255'))}",
            f"camera-height={number}",
            f"factor={number}",
            f"points:{rng.choice((number, '0', 'x.png', ''))}:{number},1:2,2={rng.choice((number, '1'))}",
            rng.choice(YAML),
        )
    )
    if rng.random() < 0.5:
        return Case(["scale", shutil.copytree(shared.run, room.path / "run"), words])
    return Case(short_run(room, shared, f"--scale={words}"))


@kind("option values", 90)
def option_values(rng: random.Random, room: Room, shared: Shared) -> Case:
    number = rng.choice(NUMBERS)
    which = rng.randrange(10)
    if which < 5:
        return Case(short_run(room, shared, "--set", f"{rng.choice(list(ranges()))}={number}"))
    if which < 8:
        return Case(short_run(room, shared, f"{rng.choice(OPTIONS)}={number}"))
    if which == 8:
        given = ",".join(rng.choice((number, "100", "50")) for _ in range(rng.choice((1, 4, 5, 8, 9))))
        return Case(short_run(room, shared, f"--intrinsics={given}"))
    words: list[list[str | Path]] = [
        ["demo", f"--frames={rng.choice(('-1', '0', 'x', '29', '999999999999'))}", "--out", room.out],
        ["localise", shared.map, shared.one_image, "--out", room.out, f"--{rng.choice(WINDOW)}={number}"],
        ["batch", shared.one_image, "--out", room.out, f"--jobs={number}", "--memory-mib=-1"],
        ["view", shared.run, f"--port={number}", f"--file={number}"],
        ["bench", "local", "--data", room.given, "--out", room.out, f"--jobs={number}"],
        ["bench", "local", "--data", room.given, "--out", room.out, f"--memory-mib={number}"],
        ["bench", "local", "--data", room.given, "--out", room.out, "--list", "--seeds", number],
        ["map", shared.run, f"--minutes={rng.choice(('nan', '-1', '0', 'inf', 'x'))}"],
    ]
    return Case(rng.choice(words))


@kind("yaml", 70)
def yaml(rng: random.Random, room: Room, shared: Shared) -> Case:
    if rng.random() < 0.3:
        key = rng.choice((*ranges(), "source", "camera.intrinsics", "nothing", "dynamics.variant", "mapping.loss", ""))
        return Case(short_run(room, shared, "--set", f"{key}={rng.choice(YAML)}"))
    file = room.given / "c.yaml"
    good = config_to_yaml(Config())
    which = rng.randrange(6)
    if which == 0:
        nasty(rng, file, good.encode())
    elif which == 1:
        file.write_bytes(garbled(rng, good.encode(rng.choice(("utf-16", "utf-8")))))
    elif which == 2:
        file.write_text(LAUGHS)
    elif which == 3:
        sparse(file, good.encode())
    else:
        section, _, key = rng.choice(list(ranges())).rpartition(".")
        body = f"{key or 'seed'}: {rng.choice(YAML)}"
        file.write_bytes((f"{section}:\n  {body}\n" if section else body + "\n").encode("utf-8", "surrogatepass"))
    if rng.random() < 0.3:
        return Case(["bench", file, "--list", "--data", room.given, "--out", room.out])
    return Case(short_run(room, shared, "--config", file))


@kind("bench suites", 30)
def bench_suites(rng: random.Random, room: Room, shared: Shared) -> Case:
    from mastd3r import suites

    shipped = sorted(Path(suites.__path__[0]).glob("*.yaml"))
    lines = rng.choice(shipped).read_text().splitlines()
    for _ in range(rng.choice((1, 1, 3))):
        n = rng.randrange(len(lines))
        key, colon, _ = lines[n].partition(":")
        lines[n] = rng.choice(
            (f"{key}{colon} {rng.choice(YAML[:4] + NUMBERS)}", "", lines[n] * 2, key, f"  {lines[n]}")
        )
    file = room.given / "s.yaml"
    file.write_text("\n".join(lines), errors="replace")
    return Case(["bench", file, "--list", "--data", room.given, "--out", room.out])


@kind("names", 60)
def names(rng: random.Random, room: Room, shared: Shared) -> Case:
    """Markup, control characters, what is too long, what is no UTF-8; for things that are there and that are not."""
    name = rng.choice(NAMES)
    path = room.given / name.replace("/", "_") if rng.random() < 0.6 else Path(name)
    short = len(os.fsencode(name)) < 250 and path.is_absolute()
    if short:
        path.mkdir(exist_ok=True)
        (path / "a.png").write_bytes(shared.pictures[0])
    words: list[list[str | Path]] = [
        ["run", path, "--out", room.out, "--no-map", "--quiet"],
        ["run", path, "--out", room.out, "--no-map"],
        short_run(room, shared, "--config", path),
        short_run(room, shared, "--maps", path),
        short_run(room, shared, f"--set=networks.mast3r={name}", "--pointmaps=mast3r"),
        ["run", shared.one_image, "--no-map", "--quiet", f"--out={room.path / 'out' / name}"],
        ["eval", path, shared.run.parent / "photos"],
        ["eval", "--trajectory", path, "--format", "tum", shared.run.parent / "photos"],
        ["export", shared.run, "--to", "tum", f"--out={room.out / name}"],
        ["export", path, "--to", name, "--out", room.out],
        ["view", path],
        ["resume", path],
        ["map", path],
        ["bench", path, "--data", path, "--list"],
        ["batch", path, "--out", room.out, f"--set={name}=1", "--quiet"],
        ["live", "--out", room.out, "--quiet", "--timeout=1", "--end=1", f"--topic={name}", "--", path],
        ["finish", path],
        ["save", path, "--map", room.out],
        ["save", shared.run, f"--map={room.path / 'out' / name}"],
        ["localise", path, shared.one_image, "--out", room.out],
        ["localise", shared.map, path, "--out", room.out],
        ["run", shared.one_image, "--map", path, "--out", room.out, "--no-map", "--quiet"],
        ["scale", path, f"factor={name}"],
        ["scale", shutil.copytree(shared.run, room.path / "run"), name],
        ["view", shared.run, f"--file={path}", "--no-browser"],
        ["view", shared.run, f"--host={name}", "--no-browser"],
        ["weights", "check", path],
        ["weights", "download", path, "--yes"],
        ["weights", "path", path],
        ["weights", "download", shared.one_image, f"--as={name}", "--yes"],
        ["download", name, name, "--yes"],
    ]
    return Case(rng.choice(words))


@kind("places to write", 40)
def places_to_write(rng: random.Random, room: Room, shared: Shared) -> Case:
    taken = room.given / "taken"
    nasty(rng, taken, b"mine")
    other = room.given / "thesis"
    other.mkdir()
    (other / "chapter.tex").write_text("years")
    out = rng.choice(
        (
            taken,
            other if taken.is_dir() else taken / "x",
            other,
            room.given,
            "/dev/null",
            "/dev/full",
            "/proc/x",
            "/proc/self/fd/1",
            "",
            "/",
            ".",
            "~nobody/x",
            "~root",
            shared.one_image,
            shared.one_image / "run",
            other / "chapter.tex" / "x",
            "x\0y",
            room.out / rng.choice(NAMES),
        )
    )
    words: list[list[str | Path]] = [
        ["run", shared.one_image, f"--out={out}", "--no-map", "--quiet"],
        ["export", shared.run, "--to", rng.choice(("tum", "kitti", "euroc", "spz", "depth")), f"--out={out}"],
        [
            "export",
            shared.run,
            "--to",
            rng.choice(("flight", "mesh", "cloud") if not shared.quick else ("spz",)),
            f"--out={room.out}.{rng.choice(NAMES[:4])}",
        ],
        [
            "eval",
            "--trajectory",
            shared.run / "trajectory.txt",
            "--format",
            "tum",
            shared.run.parent / "photos",
            f"--out={out}",
        ],
        ["bench", "local", "--data", room.given, f"--out={out}"],
        ["download", "tum", "fr1/xyz", f"--to={out}"],
        ["batch", room.given / "none", f"--out={out}", "--no-map", "--quiet"],
        ["live", shared.one_image, f"--out={out}", "--no-map", "--quiet", "--record"],
        ["save", shared.run, f"--map={out}"],
        ["localise", shared.map, shared.one_image, f"--out={out}"],
    ]
    return Case(rng.choice(words))


@kind("commands", 50)
def commands(rng: random.Random, room: Room, shared: Shared) -> Case:
    """Words in any order: unknown, doubled, left out."""
    pool = [
        *COMMANDS,
        "rum",
        "exprot",
        "--quite",
        "-v",
        "--verbose",
        "--out",
        "--to",
        "tum",
        "--set",
        "a=b",
        "--",
        "-",
        "list",
        "--no-such",
        "--seed",
        *NUMBERS[:8],
        *NAMES[:8],
        "--out=x",
        str(room.given),
        "--yes",
        "@file",
        "--quiet",
    ]
    words: list[str | Path] = [rng.choice(pool) for _ in range(rng.randrange(6))]
    bad = ("demo", "doctor", "live")
    return Case([w for w in words if w not in bad] + (["run"] if words[:1] == ["doctor"] else []))
