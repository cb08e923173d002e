#!/usr/bin/env python3
"""Make the shipped JavaScript of other projects again, with npm, from the versions in its locks.

    python .ci/vendor.py [--new-hashes]

Each folder of `FOLDERS` has a ``vendor.lock.json``. A file with a ``source`` is taken from an npm
package as it is; one with an ``entry`` is made with esbuild: one classic script of what the entry
names. It stops where a file does not have the hash of the lock. To take a new version, change it in
the lock and give ``--new-hashes``.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path
from typing import Any

PACKAGE = Path(__file__).parents[1] / "src" / "physion"
FOLDERS = (PACKAGE / "experiment" / "static" / "vendor", PACKAGE / "report" / "viewer" / "vendor")


def fetch(entry: dict[str, Any], folder: Path) -> bytes:
    """Return one file of one version of an npm package."""
    package = f"{entry['name']}@{entry['version']}"
    command = ["npm", "pack", "--silent", package]
    packed = subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True)
    with tarfile.open(folder / packed.stdout.strip()) as archive:
        member = archive.extractfile(f"package/{entry['source']}")
        if member is None:
            raise SystemExit(f"{package} holds no file {entry['source']}")
        return member.read()


def bundle(entry: dict[str, Any], folder: Path, home: Path) -> bytes:
    """Return the bundle of an entry file; the licence of its first package is copied."""
    packages = entry["packages"]
    names = [f"{name}@{version}" for name, version in packages.items()]
    (folder / "package.json").write_text('{"private": true}\n', encoding="utf-8")
    subprocess.run(["npm", "install", "--silent", *names], cwd=folder, check=True)
    shutil.copy(home / entry["entry"], folder / "entry.js")
    shutil.copy(folder / "node_modules" / next(iter(packages)) / "LICENSE", home / entry["license"])
    settings = ["--bundle", "--minify", "--format=iife", "--charset=ascii"]
    settings += [f"--global-name={entry['global']}", "--outfile=bundle.js", "--log-level=warning"]
    subprocess.run(["npx", "esbuild", "entry.js", *settings], cwd=folder, check=True)
    return (folder / "bundle.js").read_bytes()


def main(new_hashes: bool) -> None:
    """Make, check and write every file of every lock."""
    for home in FOLDERS:
        path = home / "vendor.lock.json"
        lock = json.loads(path.read_text(encoding="utf-8"))
        for entry in lock["files"]:
            with tempfile.TemporaryDirectory() as name:
                folder = Path(name)
                made = bundle(entry, folder, home) if "entry" in entry else fetch(entry, folder)
            found = hashlib.sha256(made).hexdigest()
            if new_hashes:
                entry["sha256"] = found
            elif found != entry["sha256"]:
                raise SystemExit(f"{entry['file']}: sha256 {found}, not the one of the lock")
            (home / entry["file"]).write_bytes(made)
            print(entry["file"], found, len(made))
        path.write_text(json.dumps(lock, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main("--new-hashes" in sys.argv[1:])
