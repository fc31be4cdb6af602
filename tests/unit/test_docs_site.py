"""The built site: whole, linked, and complete without a network. One build for all tests, some ten seconds."""

import re
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import pytest

import docs_site
from docs_site import api, commands
from tests.pages import ROOT

pytestmark = pytest.mark.slow


class Page(HTMLParser):
    """Ids, links, and what a browser loads by itself."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.ids: set[str] = set()
        self.links: list[str] = []
        self.loads: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        self.ids |= {given["id"]} if "id" in given else set()
        if tag == "a" and "href" in given:
            self.links.append(given["href"])
        if tag == "link" and given.get("rel") not in ("prev", "next", "canonical"):
            self.loads.append(given["href"])
        self.loads += [given["src"]] if "src" in given else []


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return docs_site.build(tmp_path_factory.mktemp("docs"))


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[Path, Page]:
    return {file: Page(file.read_text(encoding="utf-8")) for file in site.rglob("*.html") if file.name != "404.html"}


def test_no_link_and_no_anchor_leads_nowhere(pages: dict[Path, Page]):
    dead = []
    for file, page in pages.items():
        for link in page.links:
            path, _, anchor = unquote(link).partition("#")
            if re.match(r"[a-z]+:", link):
                continue
            to = (file.parent / path).resolve() if path else file
            if not to.is_file() or (anchor and to.suffix == ".html" and anchor not in pages[to].ids | {"__top"}):
                dead.append((file.name, link))
    assert len(pages) > 70
    assert dead == []


def test_nothing_is_loaded_from_another_host(site: Path, pages: dict[Path, Page]):
    for file, page in pages.items():
        assert page.loads, file
        for source in page.loads:
            assert not re.match(r"(https?:)?//", source), (file.name, source)
            if not source.startswith("data:"):
                assert (file.parent / source).is_file(), (file.name, source)
        # zensical's program fetches another one where a page has a diagram.
        assert 'class="mermaid"' not in file.read_text(encoding="utf-8"), file.name
    for style in site.rglob("*.css"):
        assert not re.search(r"(url\(|@import)\s*[\"']?(https?:)?//", style.read_text(encoding="utf-8")), style.name


def test_every_public_name_of_the_library_appears(site: Path, pages: dict[Path, Page]):
    public = api.public(ROOT)
    packages = {".".join(f.parent.relative_to(ROOT).parts) for f in ROOT.glob("pbl_pipeline/*/__init__.py")}
    without = {"pbl_pipeline.cli"}  # the commands have pages of their own
    assert packages - without <= public.keys()
    missing = []
    for module, names in public.items():
        page = pages[(site / api.FOLDER / f"{module}.html").resolve()]
        described = page.ids | {link.rpartition("#")[2] for link in page.links}
        missing += [
            f"{module}.{n}" for n in names if not any(i.startswith(module) and i.endswith(f".{n}") for i in described)
        ]
    assert sum(map(len, public.values())) > 500
    assert missing == []


def test_every_command_appears(site: Path, pages: dict[Path, Page]):
    found = {i for file, page in pages.items() if file.parent.name == "commands" for i in page.ids}
    names = [name for name, _ in commands.tree() if name != "pbl"]
    assert len(names) > 60
    assert [n for n in names if n.replace(" ", "-") not in found] == []


def test_the_search_knows_pages_commands_and_functions(site: Path):
    index = (site / "search.js").read_text(encoding="utf-8")
    assert all(word in index for word in ("Filming card", "pbl deidentify", "bland_altman", "VIDEO_TRUNCATED"))
    # Opened as a file, a page may start no worker: this stands in for it.
    assert 'src="./iframe-worker.js"' in (site / "index.html").read_text(encoding="utf-8")


def test_notebooks_show_their_results(site: Path):
    text = (site / "notebooks" / "04_study.html").read_text(encoding="utf-8")
    assert '<table border="1" class="dataframe">' in text
    assert "<svg" in text
    assert "80 persons, 216 visits" in text


def test_a_dead_link_fails_the_build(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    def stage(folder: Path) -> None:
        (folder / "src").mkdir()
        (folder / "src" / "index.md").write_text("# Start\n\n[nowhere](nowhere.md)\n")
        (folder / "zensical.toml").write_text('[project]\nsite_name = "x"\ndocs_dir = "src"\n')

    monkeypatch.setattr(docs_site._build, "stage", stage)
    with pytest.raises(docs_site.BuildError, match="page does not exist"):
        docs_site.build(tmp_path)
