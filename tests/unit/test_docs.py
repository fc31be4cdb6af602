"""The documentation names every code, variable and command there is, and none that is not."""

import ast
import itertools
import json
import re
import tomllib
from collections.abc import Iterator, Sequence
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import click
import pytest
import yaml
from markdown.extensions.toc import slugify
from packaging.requirements import Requirement

import docs_site
import pbl_pipeline
import pbl_workers  # noqa: F401  registers its codes
from docs_site import _notebook, api, commands
from pbl_pipeline.cli import TASKS
from pbl_pipeline.errors import CODES
from pbl_pipeline.report.words import VERDICT_WORDS
from pbl_schemas import STAGES, computed_tables
from pbl_schemas.chain import tables
from tests import demo_block, pages
from tests.command import pbl
from tests.source import PACKAGES, files

ROOT = pages.ROOT
#: Modules of tables: docs/tables.md has what is in them.
TABLES = {f"pbl_schemas.{stage}" for stage in STAGES}
#: Files for deployment that name our images.
DEPLOYED = ("workers/deploy/Dockerfile", "workers/deploy/kubernetes/kustomization.yaml")


def test_errors_page_lists_exactly_the_codes():
    text = (ROOT / "docs" / "errors.md").read_text()
    listed = re.findall(r"^- \*\*([A-Z_]+)\*\* \((\w+)\)", text, re.MULTILINE)
    assert sorted(listed) == sorted((name, code.cause) for name, code in CODES.items())


def test_the_settings_page_lists_every_variable():
    source = "".join(file.read_text("utf-8") for file in files(*PACKAGES))
    listed = re.findall(r"^\| (`PBL_\w+`[^|]*) \|", pages.text("docs/settings.md"), re.MULTILINE)
    assert sorted(re.findall(r"`(\w+)`", " ".join(listed))) == sorted(set(re.findall(r'"(PBL_[A-Z0-9_]+)"', source)))


def test_readme_is_short_and_has_no_placeholder():
    assert len(pages.text("README.md").split()) <= 900
    assert not re.findall(r"@[A-Z]+@", pages.text("README.md"))


def test_readme_states_how_far_its_numbers_are_compared():
    assert demo_block.stated_tolerances() in " ".join(pages.text("README.md").split())


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ("97.9 steps", "99.2 steps", "cadence"),
        ("1.226 s", "1.25 s", "stride time"),
        ("61.0 %", "62.1 %", "stance"),
        ("right 97.7", "right 95.4", "GDI of three angles"),
        ("5 cycles", "6 cycles", "GDI of three angles"),
        ("90 % interval", "95 % interval", "GDI of three angles"),
        ("89 to 107", "89 to 110", "GDI of three angles"),
        ("1.8 px", "2.5 px", "residuals of the fit"),
        ("gdi_cycles, ", "", "QC"),
    ],
)
def test_another_number_in_the_block_of_readme_is_seen(old: str, new: str, line: str):
    """The test of the demo compares them with what it printed."""
    ours = demo_block.in_readme()
    (changed,) = demo_block.differences(ours, [text.replace(old, new) for text in ours])
    assert changed.startswith(line)


def test_small_differences_in_the_block_of_readme_are_allowed_missing_lines_are_not():
    ours = demo_block.in_readme()
    close = [t.replace("97.9 steps", "97.0 steps").replace("1.226", "1.210").replace("97.9 (", "96.2 (") for t in ours]
    assert close != ours
    assert demo_block.differences(ours, close) == []
    for i in range(len(ours)):
        less = ours[:i] + ours[i + 1 :]
        assert len(demo_block.differences(ours, less)) == len(demo_block.differences(less, ours)) == 1


def test_the_version_is_the_same_everywhere():
    """Package, citation, newest heading of changelog, which a release dates, and images' tags."""
    citation = yaml.safe_load(pages.text("CITATION.cff"))
    headings = re.findall(r"^## (.*)$", pages.text("CHANGELOG.md"), re.MULTILINE)
    assert citation["version"] == pbl_pipeline.__version__
    for page in ("docker-compose.yml", "docs/deployment.md", *DEPLOYED):
        assert set(re.findall(r"(\d+\.\d+\.\d+)-[cg]pu\b", pages.text(page))) == {pbl_pipeline.__version__}, page
    assert re.fullmatch(rf"{re.escape(pbl_pipeline.__version__)} \((unreleased|\d{{4}}-\d\d-\d\d)\)", headings[0])


def test_the_citation_has_the_fields_of_its_format():
    """Those that CFF 1.2.0 requires; `make dist` checks it against the schema."""
    citation = yaml.safe_load(pages.text("CITATION.cff"))
    (paper,) = citation["references"]
    assert citation["cff-version"] == "1.2.0"
    assert {"message", "title", "authors"} <= citation.keys()
    assert {"type", "title", "authors"} <= paper.keys()
    assert paper["title"] in " ".join(pages.text("README.md").split())
    ours, *of_others = tomllib.loads(pages.text("pyproject.toml"))["project"]["license"].split(" AND ")
    assert (citation["license"], of_others) == (ours, ["MIT", "MPL-2.0"])


@pytest.mark.parametrize("page", docs_site.pages())
def test_no_link_of_a_page_is_dead(page: str):
    """As a viewer of the repository follows it; the site's own links are checked in test_docs_site.py."""
    text = _notebook.markdown(ROOT / page) if page.endswith(".ipynb") else pages.text(page)
    for target in re.findall(r"\]\(([^()\s]+)\)", re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)):
        path, _, anchor = target.partition("#")
        if "://" in target:
            continue
        file = (ROOT / page).parent / path if path else ROOT / page
        assert file.exists(), target
        if anchor:
            headings = re.findall(r"^#+ (.*)$", file.read_text(), re.MULTILINE)
            assert anchor in [slugify(re.sub(r"[`*]", "", h), "-") for h in headings], target


def test_the_page_of_licences_names_every_direct_dependency():
    project = tomllib.loads(pages.text("pyproject.toml"))["project"]
    extras = project["optional-dependencies"]
    brought = [extras[name] for name in ("s3", "export", "figures", "h5", "depth")]
    wanted = {Requirement(r).name for r in itertools.chain(project["dependencies"], *brought)}
    table = pages.text("docs/licences.md").partition("## Direct dependencies")[2]
    _, *rows = re.findall(r"^\| [^|]* \| (.*) \|$", table, re.MULTILINE)
    listed = [name for row in rows for name in row.split(", ")]
    assert sorted(listed) == sorted(wanted)


def test_the_page_of_reports_names_every_verdict():
    listed = re.findall(r"^\| ([A-Z][^|]*?) \|", pages.text("docs/report.md"), re.MULTILINE)
    assert sorted(listed) == sorted(VERDICT_WORDS.values())


def test_the_chain_of_the_contributors_page_is_the_tables_and_their_functions():
    rows = re.findall(r"^\| `([\w.]+)` \|[^|]*\|([^|]*)\|", pages.text("docs/house.md"), re.MULTILINE)
    names = {table: name for name, table in tables().items()}
    computed = [names[table] for table in computed_tables()]
    beside = {"validation.KinematicError", "privacy.Deidentified"}  # on request
    assert [name for name, _ in rows if name != "fit.FitSet"] == [name for name in computed if name not in beside]
    public = api.public(ROOT)
    for name, calls in rows:
        for package, function in re.findall(r"`(\w+)\.(\w+)`", calls):
            assert function in public[f"pbl_pipeline.{package}"], name


def test_every_page_is_in_the_menu_once(tmp_path: Path):
    src = docs_site.stage(tmp_path)
    menu = list(_menu(tomllib.loads((tmp_path / "zensical.toml").read_text())["project"]["nav"]))
    assert sorted(menu) == sorted(p.relative_to(src).as_posix() for p in src.rglob("*.md"))


def _menu(entries: Any) -> Iterator[str]:
    if isinstance(entries, str):
        yield entries
    else:
        for entry in entries.values() if isinstance(entries, dict) else entries:
            yield from _menu(entry)


@pytest.mark.parametrize("page", pages.pages())
def test_json_can_be_read_and_what_is_run_exists(page: str):
    for block in pages.blocks(page):
        if block.language == "json":
            json.loads(block.code)
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    assert set(re.findall(r"`make ([a-z-]+)`", pages.text(page))) <= targets
    for module in re.findall(r"python -m ([a-z_]+(?:\.[a-z_]+)*)(?![.\w])", pages.text(page)):
        if (ROOT / module.split(".")[0]).is_dir():
            path = ROOT.joinpath(*module.split("."))
            assert path.with_suffix(".py").is_file() or (path / "__main__.py").is_file(), module


def test_what_the_examples_import_is_public_and_in_the_reference():
    public = api.public(ROOT)
    code = [
        (b.page, b.code) for b in pages.python_blocks() if b.page != "docs/extending.md"
    ]  # that one is inside the library
    for notebook in sorted(ROOT.glob("docs/notebooks/*.ipynb")):
        cells = json.loads(notebook.read_text())["cells"]
        code += [(notebook.name, "".join(c["source"])) for c in cells if c["cell_type"] == "code"]
    found = []
    for page, text in code:
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.ImportFrom) and str(node.module).partition(".")[0] in (
                "pbl_pipeline",
                "pbl_schemas",
            ):
                for alias in node.names:
                    module = f"{node.module}.{alias.name}"
                    if module not in TABLES | public.keys() and alias.name not in public.get(str(node.module), ()):
                        found.append((page, module))
    assert found == []


def test_every_command_has_help_with_an_example():
    commands = entry_points(group="pbl.commands")
    assert len(commands) > 15
    for entry in commands:
        command = entry.load()
        assert "Example:" in command.get_help(click.Context(command)), entry.name


@pytest.mark.parametrize("group", ["pbl.bench", "pbl.study", "pbl.study_data"])
def test_what_the_tables_and_workers_add_to_commands_is_there(group: str):
    assert all(callable(entry.load()) for entry in entry_points(group=group))


def test_the_help_lists_every_command_under_one_task():
    listed = [name for names in TASKS.values() for name in names]
    assert sorted(listed) == sorted(entry.name for entry in entry_points(group="pbl.commands"))
    shown = pbl("--help").out
    assert "Further commands" not in shown
    assert all(f"\n{task}:\n" in shown for task in TASKS)
    assert all(shown.count(f"\n  {name} ") == 1 for name in listed)


# --- Every call of `pbl` that the documentation shows is one that `pbl` takes.


TREE = dict(commands.tree())
#: Groups that are a command of theirs where none is named.
DEFAULT = {"pbl validate": "pbl validate tables"}
#: Words that stand for any command.
ANY = {"COMMAND"}


def wrong(words: Sequence[str], *, whole: bool) -> str:
    """What `pbl` would say of a call, "" where it takes it. Not `whole`: options may stand without their value."""
    name, rest = "pbl", list(words)
    while rest and f"{name} {rest[0]}" in TREE:
        name = f"{name} {rest.pop(0)}"
    if rest or whole:
        name = DEFAULT.get(name, name)
    ctx = TREE[name]
    if name == "pbl" and rest and rest[0] in ANY:
        return ""
    try:
        found, extra, _ = ctx.command.make_parser(ctx).parse_args(rest)
        if extra:
            return f"{name}: {extra}?"
        if whole:
            for param in ctx.command.params:
                value = found.get(param.name or "")
                missing = value is None or value == () or type(value).__name__ == "Sentinel"
                if not missing:
                    if isinstance(param.type, click.Choice):
                        param.type_cast_value(ctx, value)
                elif param.required:
                    return f"{name}: {param.name} is missing"
    except click.BadOptionUsage as error:
        return str(error) if whole else ""
    except click.UsageError as error:
        return error.format_message()
    return ""


@pytest.mark.parametrize("page", pages.pages())
def test_the_commands_of_a_page(page: str):
    blocks = [c for b in pages.blocks(page) if b.language in ("", "sh", "text") for c in pages.commands(b.code)]
    found = {" ".join(c): wrong(c, whole=True) for c in blocks}
    found |= {" ".join(c): wrong(c, whole=False) for c in pages.commands_in_prose(page)}
    assert {call: why for call, why in found.items() if why} == {}


def test_the_examples_of_the_help():
    found = {}
    for ctx in TREE.values():
        ctx.terminal_width = 1000  # no line is broken
        found |= {" ".join(c): wrong(c, whole=True) for c in pages.commands(ctx.get_help())}
    assert len(found) > 60
    assert {call: why for call, why in found.items() if why} == {}


@pytest.mark.parametrize(
    "call",
    [
        "run --outt results walk.mp4",
        "runn walk.mp4",
        "run",
        "run walk.mp4 --out",
        "db begin",
        "db init now",
        "deidentify walk.mp4 --how paint",
    ],
)
def test_a_wrong_call_is_seen(call: str):
    assert wrong(call.split(), whole=True)
