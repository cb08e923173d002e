"""The wheel holds the whole package, the sdist what a distributor needs, and neither more."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tarfile
import venv
import zipfile
from importlib.util import find_spec
from pathlib import Path

import pytest

import physion
from support.paths import ROOT
from support.programs import absent

PACKAGE = ROOT / "src" / "physion"
TOP = {
    *(
        ".ci",
        ".devcontainer",
        ".dockerignore",
        "Dockerfile",
        "benchmarks",
        "docs",
        "examples",
        "src",
        "tests",
        ".gitignore",
        "CHANGELOG.md",
    ),
    *("CITATION.cff", "CONTRIBUTING.md", "LICENSE", "PKG-INFO", "README.md", "eslint.config.js"),
    *("mkdocs.yml", "package.json", "pyproject.toml", "requirements.lock", "tsconfig.json"),
}
"""What the sdist may have in its first folder."""
LICENSES = {
    "LICENSE",
    "src/physion/data/official_study/LICENSE.official.txt",
    "src/physion/experiment/static/vendor/LICENSE.bundled.txt",
    "src/physion/experiment/static/vendor/LICENSE.jspsych.txt",
    "src/physion/report/viewer/vendor/LICENSE.three.txt",
}


def build(root: Path, folder: Path, *targets: str) -> None:
    if find_spec("hatchling") is None:
        absent("hatchling is absent: pip install -e '.[dev]'")
    command = [sys.executable, "-m", "hatchling", "build", "-d", str(folder)]
    for target in targets:
        command += ["-t", target]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with a wheel and an sdist of this repository."""
    folder = tmp_path_factory.mktemp("built")
    build(ROOT, folder, "sdist", "wheel")
    return folder


def wheel_files(folder: Path) -> dict[str, bytes]:
    (path,) = folder.glob("*.whl")
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def sdist_files(folder: Path) -> dict[str, bytes]:
    (path,) = folder.glob("*.tar.gz")
    files = {}
    with tarfile.open(path) as archive:
        for member in archive.getmembers():
            assert member.isfile() and ".." not in member.name, member.name
            content = archive.extractfile(member)
            assert content is not None
            files[member.name.partition("/")[2]] = content.read()
    return files


@pytest.mark.slow
def test_the_wheel_is_the_package_and_its_metadata(built: Path) -> None:
    files = wheel_files(built)
    info = f"physion_benchmark-{physion.__version__}.dist-info/"
    packed = {name for name in files if not name.startswith(info)}
    wanted = {
        path.relative_to(PACKAGE.parent).as_posix()
        for path in PACKAGE.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert packed == wanted and "physion/py.typed" in packed
    assert {name for name in files if name.startswith(f"{info}licenses/")} == {
        f"{info}licenses/{name}" for name in LICENSES
    }
    assert f"\nVersion: {physion.__version__}\n" in files[f"{info}METADATA"].decode()


@pytest.mark.slow
def test_the_sdist_has_tests_docs_and_licences_and_nothing_else(built: Path) -> None:
    files = sdist_files(built)
    assert {name.partition("/")[0] for name in files} <= TOP
    assert set(files) >= LICENSES
    here = "tests/distribution/test_wheel_and_sdist.py"
    assert {here, "docs/explanation/architecture.md", "examples/my_model/my_encoder.py"} <= set(
        files
    )
    assert not [name for name in files if {"__pycache__", "node_modules"} & set(name.split("/"))]


@pytest.mark.slow
def test_only_what_git_knows_is_packed(built: Path) -> None:
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    if listed.returncode:
        pytest.skip("this is not a git repository")
    assert set(sdist_files(built)) - {"PKG-INFO"} <= set(listed.stdout.splitlines())


@pytest.mark.slow
def test_no_path_of_this_machine_is_packed(built: Path) -> None:
    private = [str(path).encode() for path in (ROOT, Path.home()) if len(path.parts) > 2]
    for name, content in (sdist_files(built) | wheel_files(built)).items():
        assert not [text for text in private if text in content], name


@pytest.mark.slow
def test_the_wheel_of_the_sdist_is_the_same(built: Path, tmp_path: Path) -> None:
    (path,) = built.glob("*.tar.gz")
    with tarfile.open(path) as archive:
        archive.extractall(tmp_path / "source", filter="data")
    (root,) = (tmp_path / "source").iterdir()
    build(root, tmp_path / "again", "wheel")
    assert wheel_files(tmp_path / "again") == wheel_files(built)


@pytest.mark.nightly
@pytest.mark.slow
def test_an_installed_wheel_runs_in_another_folder(built: Path, tmp_path: Path) -> None:
    """Dependencies come from this environment, the package itself only from the wheel."""
    venv.create(tmp_path / "venv", with_pip=False)
    bin_folder = tmp_path / "venv" / ("Scripts" if os.name == "nt" else "bin")
    python = bin_folder / "python"
    (wheel,) = built.glob("*.whl")
    environment = {name: text for name, text in os.environ.items() if name != "PYTHONPATH"}
    environment["OMP_NUM_THREADS"] = "1"
    folder = tmp_path / "elsewhere"
    folder.mkdir()

    def run(*command: str | Path) -> str:
        done = subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, f"{command}: {done.stdout}{done.stderr}"
        return done.stdout

    pip = ["-m", "pip", "--python", python, "--disable-pip-version-check"]
    run(sys.executable, *pip, "install", "--quiet", "--no-deps", "--no-index", wheel)
    where = "import sysconfig; print(sysconfig.get_path('purelib'))"
    site = Path(run(python, "-c", where).strip())
    # A folder in a .pth file is searched last, and the .pth files in it are not read.
    folders = [path for path in sys.path if path.endswith(("site-packages", "dist-packages"))]
    (site / "dependencies.pth").write_text("\n".join(folders) + "\n")
    assert str(site) in run(python, "-c", "import physion; print(physion.__file__)")
    # The machine code of equal sources is equal: what was compiled here need not be again.
    for path in PACKAGE.rglob("__pycache__/*.nb[ic]"):
        target = site / path.relative_to(PACKAGE.parent)
        target.parent.mkdir(exist_ok=True)
        shutil.copyfile(path, target)
    physion_ = bin_folder / "physion"
    assert run(physion_, "--version") == f"physion {physion.__version__}\n"
    tiny = ["--width", "64", "--height", "64", "--jitters", "0", "--count", "2"]
    for split in ("testing", "familiarization"):
        run(physion_, "generate", "trials", "--scenario", "drop", "--split", split, *tiny)
    run(physion_, "evaluate", "gns,state-trees", "trials", "--out", "models")
    # Data of the study, templates and pages of the experiment come from the wheel, too.
    tables = (folder / "models" / "predictions").glob("*.csv")
    run(physion_, "compare", *map(str, tables), "--out", "report")
    assert (folder / "report" / "report.html").is_file()
    run(physion_, "view", "trials", "--trials", "1", "--details", "1")
    contact = ["--contact", "Ada, ada@example.org"]
    run(physion_, "experiment", "init", "study", "--trials", "trials", "--practice", "2", *contact)
    assert (folder / "study" / "study.toml").is_file()
