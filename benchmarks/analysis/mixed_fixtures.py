"""R's answers to the mixed models that the tests fit: writes support/fixtures/mixed_r.csv.

    python benchmarks/analysis/mixed_fixtures.py [--install] [--case NAME ...]

``--install`` first installs R and its packages from Debian (as root): r-base-core, r-cran-lme4,
r-cran-lmertest, r-cran-glmmtmb. The data are made from a fixed seed (tests/support/mixed_cases.py)
and their digest is stored beside the numbers. ``--case`` redoes some and keeps the others. lme4
needs many minutes for the case "big".
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import pandas as pd

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "tests"))

from support.mixed_cases import CASES, STORED, Case, as_csv, digest, published  # noqa: E402
from support.official import official_folder  # noqa: E402

PACKAGES = ("r-base-core", "r-cran-lme4", "r-cran-lmertest", "r-cran-glmmtmb")
COLUMNS = ["case", "fitter", "quantity", "term", "value"]


def install() -> None:
    """R and the three packages, from Debian."""
    subprocess.run(["apt-get", "update", "-q"], check=True)
    command = ["apt-get", "install", "-y", "--no-install-recommends", *PACKAGES]
    subprocess.run(command, check=True)


def ask_r(name: str, case: Case, fitters: str = "lme4,glmmTMB") -> pd.DataFrame:
    """R's numbers for one case, one row a number, with the digest of the data."""
    data = case.data()
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "data.csv", Path(folder) / "numbers.csv"
        source.write_bytes(as_csv(data))
        script = Path(__file__).with_suffix(".R")
        asked = [name, case.kind, case.formula, str(source), str(target), fitters]
        subprocess.run(["Rscript", str(script), *asked], check=True)
        numbers = pd.read_csv(target, names=COLUMNS, keep_default_na=False)
    known = pd.DataFrame([[name, "data", "digest", "", digest(data)]], columns=COLUMNS)
    return pd.concat([known, numbers.astype({"value": str})], ignore_index=True)


def main() -> None:
    """Ask R for the chosen cases and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--install", action="store_true")
    parser.add_argument("--case", action="append", choices=list(CASES))
    chosen = parser.parse_args()
    if chosen.install:
        install()
    names = chosen.case or list(CASES)
    for name in names:
        print(name, flush=True)
        if CASES[name].data is published and official_folder() is None:
            print("  left as it is: the official data is absent")
            continue
        fresh = ask_r(name, CASES[name])
        # Read again for each: a long case must not undo what was stored meanwhile.
        old = pd.read_csv(STORED, dtype=str, keep_default_na=False) if STORED.exists() else None
        parts = [] if old is None else [old[old["case"] != name]]
        table = pd.concat([*parts, fresh], ignore_index=True)
        order = table["case"].map(list(CASES).index)
        table = table.iloc[order.argsort(kind="stable")]
        STORED.write_text(table.to_csv(index=False, lineterminator="\n"))


if __name__ == "__main__":
    main()
