"""Make ``three.min.js`` again, with npm, from the versions in ``vendor.lock.json``.

``python rebuild.py`` installs three.js and esbuild in a temporary folder, bundles what
``three.entry.js`` names into one classic script that defines ``Three``, and writes it with the
licence here; it stops where the result does not have the hash of the lock. To take a new version,
change it in the lock and run ``python rebuild.py --new-hashes``.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).parent
LOCK = HERE / "vendor.lock.json"


def bundle(packages: dict[str, str], folder: Path) -> bytes:
    """Return the bundle of ``three.entry.js``, made in an empty folder."""
    names = [f"{name}@{version}" for name, version in packages.items()]
    (folder / "package.json").write_text('{"private": true}\n', encoding="utf-8")
    subprocess.run(["npm", "install", "--silent", *names], cwd=folder, check=True)
    shutil.copy(HERE / "three.entry.js", folder / "entry.js")
    shutil.copy(folder / "node_modules" / "three" / "LICENSE", HERE / "LICENSE.three.txt")
    settings = ["--bundle", "--minify", "--format=iife", "--global-name=Three", "--charset=ascii"]
    command = ["npx", "esbuild", "entry.js", *settings, "--outfile=three.min.js"]
    subprocess.run([*command, "--log-level=warning"], cwd=folder, check=True)
    return (folder / "three.min.js").read_bytes()


def main(new_hashes: bool) -> None:
    """Bundle, check and write."""
    lock = json.loads(LOCK.read_text(encoding="utf-8"))
    with tempfile.TemporaryDirectory() as folder:
        data = bundle(lock["packages"], Path(folder))
    found = hashlib.sha256(data).hexdigest()
    if new_hashes:
        lock["sha256"] = found
    elif found != lock["sha256"]:
        raise SystemExit(f"three.min.js: sha256 {found}, the lock says {lock['sha256']}")
    (HERE / "three.min.js").write_bytes(data)
    LOCK.write_text(json.dumps(lock, indent=2) + "\n", encoding="utf-8")
    print("three.min.js", found, len(data))


if __name__ == "__main__":
    main("--new-hashes" in sys.argv[1:])
