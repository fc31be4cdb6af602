"""The version that rows and files carry names the commit."""

import re
import subprocess
import tomllib
from pathlib import Path

import pytest

from pbl_pipeline import __version__, code_version
from pbl_pipeline.code_version import built_commit, checked_out_commit
from tests import Environment, Limits
from tests.command import pbl


def git(root: Path, *arguments: str) -> str:
    who = ["-c", "user.name=a", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=false"]
    done = subprocess.run(["git", "-C", str(root), *who, *arguments], capture_output=True, text=True, check=True)
    return done.stdout.strip()


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    git(tmp_path, "init", "--quiet")
    package = tmp_path / "pbl_pipeline"
    package.mkdir()
    (package / "a.py").write_text("a = 1\n")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "--quiet", "--message", "one")
    return tmp_path


def test_two_commits_differ_and_a_changed_file_shows(checkout: Path):
    one = checked_out_commit(checkout)
    assert git(checkout, "rev-parse", "HEAD").startswith(one)
    assert len(one) == 12
    (checkout / "notes.txt").write_text("not code")
    assert checked_out_commit(checkout) == one
    (checkout / "pbl_pipeline" / "a.py").write_text("a = 2\n")
    assert checked_out_commit(checkout) == f"{one}.dirty"
    git(checkout, "commit", "--quiet", "--all", "--message", "two")
    two = checked_out_commit(checkout)
    assert two != one
    assert git(checkout, "rev-parse", "HEAD").startswith(two)
    (checkout / "pbl_pipeline" / "new.py").write_text("")
    assert checked_out_commit(checkout) == f"{two}.dirty"


def test_a_folder_inside_of_another_repository_has_no_commit(checkout: Path):
    assert checked_out_commit(checkout / "pbl_pipeline") == ""


def test_without_git_there_is_no_commit(checkout: Path, environment: Environment):
    environment(PATH="")
    assert checked_out_commit(checkout) == ""


def test_the_wheel_says_its_commit_first(tmp_path: Path, limits: Limits):
    file = tmp_path / "_commit.txt"
    assert built_commit(file) == ""
    file.write_text("0123456789ab\n")
    limits(code_version, COMMIT_FILE=file, _ROOT=tmp_path)
    version = code_version.code_version.__wrapped__  # without what this process found before
    assert version() == f"{__version__}+g0123456789ab"
    file.unlink()
    assert version() == __version__


def test_the_version_is_stated_once_and_shown_with_its_commit():
    root = Path(__file__).parents[2]
    stated = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))
    assert "version" not in stated["project"]
    assert stated["project"]["dynamic"] == ["version"]
    assert stated["tool"]["hatch"]["version"]["path"] == "pbl_pipeline/__init__.py"
    shown = pbl("--version")
    assert (shown.code, shown.out) == (0, f"pbl, version {code_version.code_version()}\n")
    # Whoever shows a version shows it with its commit: nothing else reads the bare one.
    bare = {
        str(path.relative_to(root))
        for package in code_version.PACKAGES
        for path in (root / package).rglob("*.py")
        if re.search(r"(?<![.\w])__version__|pbl_pipeline\.__version__", path.read_text(encoding="utf-8"))
    }
    assert bare == {"pbl_pipeline/__init__.py", "pbl_pipeline/code_version.py"}


def test_it_fits_its_column():
    assert code_version.code_version().startswith(__version__)
    assert len(code_version.code_version()) <= 64
