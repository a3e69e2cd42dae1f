"""What the repository says about itself is true: pins, commands, versions, links, and nobody's own paths."""

from __future__ import annotations

import os
import re
import subprocess
import tomllib
import zipfile
from pathlib import Path

import pytest
import tomli_w
from hatchling.builders.wheel import WheelBuilder
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import rfdropo_bayes
from rfdropo_bayes.cli.main import app
from rfdropo_bayes.model.experiment import load_experiment

REPOSITORY = Path(__file__).resolve().parents[1]
STUDIES = "studies/requirements.txt"
PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
DOCUMENTS = sorted(REPOSITORY.glob("*.md")) + sorted((REPOSITORY / "docs").rglob("*.md"))

README = (REPOSITORY / "README.md").read_text()

OWN_PATH = re.compile(r"(?<![\w./~$}])/(?:home|Users|root|work|tmp|mnt|farm)/\w")
INDEX_OPTION = re.compile(r"--(?:extra-)?index[-]url|--find[-]links|--trusted[-]host")


def requirements(extra: str | None) -> list[Requirement]:
    if extra == STUDIES:
        lines = [line for line in (REPOSITORY / STUDIES).read_text().splitlines() if not line.startswith("#")]
    else:
        lines = PROJECT["dependencies"] if extra is None else PROJECT["optional-dependencies"][extra]
    return [requirement for requirement in map(Requirement, lines) if requirement.name != PROJECT["name"]]


def constraints() -> dict[str, str]:
    lines = (REPOSITORY / "constraints.txt").read_text().splitlines()
    pairs = [line.split("==") for line in lines if line and not line.startswith("#")]
    return {canonicalize_name(name): version for name, version in pairs}


def test_every_fault_of_the_mutants_can_be_put_in() -> None:
    """The text of a fault stands once in its file, and its tests are there: a renamed variable would hide it."""
    faults = tomllib.loads((REPOSITORY / "tools" / "mutants.toml").read_text())["fault"]
    assert faults
    for fault in faults:
        assert (REPOSITORY / "rfdropo_bayes" / fault["file"]).read_text().count(fault["old"]) == 1, fault
        for test in fault["tests"]:
            path, _, name = test.partition("::")
            assert f"def {name.partition('[')[0]}" in (REPOSITORY / path).read_text(), test


def make_targets() -> set[str]:
    return set(re.findall(r"^([a-z][a-z-]*):", (REPOSITORY / "Makefile").read_text(), flags=re.MULTILINE))


def code_in(document: Path) -> str:
    """Text of a Markdown file that is set as code."""
    return "\n".join(re.findall(r"```.*?```|`[^`\n]+`", document.read_text(), flags=re.DOTALL))


def tracked_text() -> list[tuple[str, str]]:
    """Name and text of every text file in git; empty where this is no checkout."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=REPOSITORY, capture_output=True, text=True, check=False)
    found = []
    for name in filter(None, listed.stdout.split("\0")):
        try:
            found.append((name, (REPOSITORY / name).read_text(encoding="utf-8")))
        except (UnicodeDecodeError, OSError):
            continue
    return found


@pytest.mark.parametrize("extra", [None, *PROJECT["optional-dependencies"], STUDIES])
def test_every_dependency_is_pinned_inside_its_range(extra: str | None) -> None:
    pins = constraints()
    for requirement in requirements(extra):
        name = canonicalize_name(requirement.name)
        assert name in pins, f"{name} is missing from constraints.txt"
        assert requirement.specifier.contains(pins[name]), f"{name}=={pins[name]} is outside {requirement.specifier}"


def test_no_accelerator_packages_are_pinned() -> None:
    assert not [name for name in constraints() if re.search(r"nvidia|cuda|triton|rocm", name)]


def test_documents_link_to_what_is_in_git() -> None:
    """A folder that git ignores is there for its author alone."""
    texts = dict(tracked_text())
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=REPOSITORY, capture_output=True, text=True, check=False)
    files = set(filter(None, listed.stdout.split("\0")))
    if not files:
        pytest.skip("this is no checkout, so that nothing says which files are in git")
    folders = {str(parent) for file in files for parent in Path(file).parents}
    lost = []
    for name, text in texts.items():
        if not name.endswith(".md"):
            continue
        for link in re.findall(r"\]\(([^)\s#]+)", re.sub(r"```.*?```|`[^`\n]*`", "", text, flags=re.DOTALL)):
            if re.match(r"[a-z]+:", link):
                continue
            target = os.path.normpath(Path(name).parent / link)
            if target not in files | folders:
                lost.append(f"{name}: {link}")
    assert not lost


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_documented_make_commands_exist(document: Path) -> None:
    named = set(re.findall(r"\bmake ([a-z][a-z-]*)", code_in(document)))
    assert named <= make_targets(), f"{document.name} names {sorted(named - make_targets())}"


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_documented_rfdropo_commands_exist(document: Path) -> None:
    known = {command.name or command.callback.__name__ for command in app.registered_commands if command.callback}
    known |= {group.name for group in app.registered_groups}
    named = set(re.findall(r"\brfdropo +([a-z][a-z-]*)", code_in(document)))
    assert named <= known, f"{document.name} names {sorted(named - known)}"


def test_the_columns_of_a_plain_csv_are_valid(tmp_path: Path) -> None:
    """The example of recordings.md in an experiment."""
    page = (REPOSITORY / "docs" / "recordings.md").read_text()
    data = tomllib.loads(re.findall(r"```toml\n(.*?)```", page, flags=re.DOTALL)[0])
    path = tmp_path / "plain.toml"
    path.write_text(tomli_w.dumps({"robot": "smooth_arm", "model": {"priors": {"young_modulus": {}}}} | data))
    experiment, _ = load_experiment(path)
    assert experiment.data.columns.position_unit == "mm"


def test_the_two_commands_are_in_the_readme() -> None:
    assert {"make demo", "make test"} <= set(re.findall(r"make [a-z-]+", code_in(REPOSITORY / "README.md")))


REPORTS = sorted((REPOSITORY / "reports").glob("*/*.md"))


@pytest.mark.parametrize("page", REPORTS, ids=lambda path: f"{path.parent.name}/{path.name}")
def test_links_of_reports_lead_to_files_and_headings(page: Path) -> None:
    missing = []
    for name, heading in re.findall(r"\]\((?!https?://)([^)#]*)(?:#([^)]+))?\)", page.read_text(encoding="utf-8")):
        found = page.parent / name if name else page
        headings = re.findall(r"^#+ (.+)$", found.read_text(encoding="utf-8"), re.MULTILINE) if heading else []
        known = {re.sub(r"[^\w -]", "", words.lower()).replace(" ", "-") for words in headings}
        missing += [] if found.exists() and (not heading or heading in known) else [f"{name}#{heading}"]
    assert missing == []


def test_what_contributing_points_to_is_there() -> None:
    """Modules in the second column of "Code map", tests in the last; a bare name is beside the last."""
    lines = (REPOSITORY / "CONTRIBUTING.md").read_text(encoding="utf-8").split("## Code map")[1].splitlines()
    rows = [line.split("|")[1:-1] for line in lines if line.startswith("| ")]
    missing = []
    for row in rows:
        for cell, base in ((row[1], REPOSITORY / "rfdropo_bayes"), (row[-1], REPOSITORY / "tests")):
            folder = base
            for name in re.findall(r"`([a-z_0-9/]+(?:\.py|/))`", cell):
                path = base / name.removeprefix("rfdropo_bayes/").removeprefix("tests/")
                folder = path.parent if "/" in name.rstrip("/") else folder
                missing += [] if path.exists() or (folder / name).exists() else [name]
    assert len(rows) > 20
    assert not missing


def test_the_version_is_the_same_everywhere() -> None:
    version = rfdropo_bayes.__version__
    assert f"\nversion: {version}\n" in (REPOSITORY / "CITATION.cff").read_text()
    short = re.escape(version.rsplit(".", 1)[0])
    assert re.search(rf"^Version {short}\b", README, flags=re.MULTILINE)


def test_the_wheel_holds_code_robots_and_experiments(tmp_path: Path) -> None:
    built = next(WheelBuilder(str(REPOSITORY)).build(directory=str(tmp_path), versions=["standard"]))
    names = set(zipfile.ZipFile(built).namelist())
    expected = {path.relative_to(REPOSITORY).as_posix() for path in (REPOSITORY / "rfdropo_bayes").rglob("*.py")}
    for folder in ("models/robots", "experiments"):
        expected |= {f"rfdropo_bayes/{folder}/{path.name}" for path in (REPOSITORY / folder).glob("*.toml")}
    assert expected <= names
    assert not [name for name in names if name.startswith(("tests/", "shared/", "reports/"))]


def test_files_name_no_machine_and_no_package_index() -> None:
    bad = []
    for name, text in tracked_text():
        for number, line in enumerate(text.splitlines(), start=1):
            if OWN_PATH.search(line) or INDEX_OPTION.search(line):
                bad.append(f"{name}:{number}: {line.strip()[:100]}")
    assert not bad, "\n".join(bad)


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("data = '/home/" + "someone/data.csv'", True),
        ("open('/tmp/" + "x')", True),
        ("see ../shared/work/notes", False),
        ("#!/usr/bin/env bash", False),
        ("https://example.org/home/page", False),
    ],
)
def test_the_search_for_own_paths_finds_them(line: str, found: bool) -> None:
    assert bool(OWN_PATH.search(line)) is found
