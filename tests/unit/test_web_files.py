"""The review page's own files: texts in both languages, scripts of others as published, views at module level."""

import ast
import csv
import hashlib
import html
import itertools
import re
import string
from pathlib import Path

from pbl_pipeline import texts, words
from pbl_pipeline.body import SLIDES, load_body
from pbl_pipeline.qc import CADENCE
from pbl_pipeline.sensors import SEGMENTS
from pbl_pipeline.shipped import shipped_text
from tests.source import PACKAGES, ROOT, files, nodes

WEB = Path(texts.__file__).parents[1] / "workers/pbl_workers/web"
_PAGES = [*WEB.glob("templates/*.html"), *WEB.glob("*.py"), Path(texts.__file__)]


def own() -> dict[str, dict[str, str]]:
    """The page's own texts by name; those of the library have its English as name."""
    return {name: t for name, t in texts.catalogue().items() if not name.startswith(("library.", "said."))}


def test_every_text_is_in_both_languages_with_the_same_places():
    for name, by_language in own().items():
        assert set(by_language) == set(texts.LANGUAGES), name
        places = {frozenset(p for _, p, _, _ in string.Formatter().parse(t) if p) for t in by_language.values()}
        assert len(places) == 1, name


def test_every_text_that_a_page_names_is_in_the_catalogue():
    named = {n for f in _PAGES for n in re.findall(r"""\bt\("([a-z_]+\.[A-Za-z_]+)"[,)]""", f.read_text())}
    assert len(named) > 40
    assert named <= set(own())


#: Groups and texts that are named by a value: a state, an outcome, a reason, a filter, an event.
_BY_VALUE = re.compile(
    r"(role|state|quality|trend|enter|decided|instruments|register|expects|upload)\.|visits\.(cohort|role|quality|state)|recording\.foot_"
    r"|operate\.(done|empty|pending|reserved|error|waiting|oldest|per_hour|left)$"
    r"|unusable\.|usable\.(yes|no)|byhand\.(automatic|hand)|differs\.|filmed\.|capture\.|coded\.|film\.is_|curves\.(matched|far)_"
)


def test_every_text_of_the_catalogue_is_on_a_page():
    pages = "".join(f.read_text() for f in _PAGES)
    assert not [n for n in own() if not _BY_VALUE.match(n) and not re.search(f"[\"']{n}[\"']", pages)]


#: Functions that make a check -> the place of its name among their arguments.
_NAMED_AT = {"Check": 0, "_limit_check": 0, "warn_if": 1}


def said_by_the_library() -> tuple[set[str], list[re.Pattern[str]], set[str]]:
    """The texts in the library's sources, patterns of those with places, and the names of its checks."""
    plain, placed, checks = set(), [], set()
    for path in files(*PACKAGES):
        for node in nodes(path):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                plain.add(node.value)
            elif isinstance(node, ast.JoinedStr):
                parts = [re.escape(p.value) if isinstance(p, ast.Constant) else "(.+)" for p in node.values]  # pyright: ignore[reportArgumentType]
                placed.append(re.compile("".join(parts)))
            elif isinstance(node, ast.Call) and (called := getattr(node.func, "id", "")) in _NAMED_AT:
                checks.add(name if isinstance(name := getattr(node.args[_NAMED_AT[called]], "value", ""), str) else "")
    return plain, placed, checks - {""} | {CADENCE}  # which has its name in a constant


def test_what_the_library_says_is_in_every_language():
    plain, placed, checks = said_by_the_library()
    names = {words.check_words(c) for c in checks}
    names |= {w for measure in words.MEASURES.values() for w in measure[:2]} | {
        w for a in words.ANGLES.values() for w in a
    }
    ours = {name.removeprefix("library."): t for name, t in texts.catalogue().items() if "library." in name[:8]}
    assert len(checks) > 30
    assert names - {""} <= set(ours)
    assert all(set(t) | {"en"} == set(texts.LANGUAGES) for t in ours.values())
    # A sentence that the library does not say any more is dead here, unless rows of earlier versions hold it.
    stored = {
        "Person {n} is the one whom somebody chose by hand in the tracking {method}.",
        "In the tracking {method} person {n} was chosen by hand, whom nobody here surely is. A person has to choose "
        "again.",
        "the hips are {n} leg lengths above the feet: nobody stands",
        "walking, but not {n} foot downs",
        "the stated height is far from what is seen (value: their ratio): a mistyped height, another person, or a "
        "child, whom a phone's detector takes for an adult and on whom nobody has measured its index",
        "the keypoints do not state {fields}: a lens without distortion, a camera that nobody measured and the box "
        "around the points stand for them; write the fields (docs/files.md)",
    }
    with (PACKAGES["pbl_schemas"] / "pbl_schemas/instruments.csv").open(encoding="utf-8") as file:
        instruments = {"points", *(row[1] for row in csv.reader(file))}
    # Put together of more than one text of the library.
    composed = re.compile(
        r"walks (part of the time )?(across|to and from|towards|away from) the (picture|camera)|look at the overlay"
        r"|the GDI needs .*|(only one|\{n\}) gait cycles?, and the first and last steps of a walk are excluded"
        r"|keep head and feet in the picture, .*|the whole person is in view in .*, without a gap"
        r"|the picture of the person .*|(feet|head) cut share"
        r"|\{name\} of '\{value\}'|the measure '\{name\}'|\{table\} waits for a choice: \{note\}(; next: \{step\})?"
        # Of the report: a count and its word, a side, a source.
        r"|\{n\} of \{all\} checks? asks? for attention:|\{n\} gait cycles? used of \{all\} found: .*"
        r"|the (left|right) leg, which was behind the other, .*|each dot is one gait cycle.*|(left|right) (mean )?\{.*"
        r"|\{way\}, no norm|(level, )?estimated(: gait)?|\{n\}, (not )?converged"
        r"|.*control subjects of.*|.*electronic addendum.*"
        r"|laboratory model of Plug-in-Gait kind .*|mapped to the fitted body: .*|median \{n\} as the detector .*",
        re.IGNORECASE,
    )
    report = re.sub(r'aria-label="(.*?)"', r">\1<", shipped_text("report/templates/report.html"))
    report = html.unescape(re.sub(r"\s*(<[^>]*>|\{[%{].*?[%}]\})", "\0", report))
    report += "\0".join(f.read_text("utf-8") for f in sorted((ROOT / "pbl_pipeline/report").glob("*.py")))
    report = re.sub(r'"\n +f?"', "", report)  # a text over several lines
    pool = "\0".join([*plain, report])
    parts = {e: [part.strip() for part in re.split(r"\{\w+\}", e)] if "{" in e else [] for e in ours}
    dead = [
        e
        for e in ours
        if e not in plain | names | instruments | stored | set(load_body().joint_names)
        and not composed.fullmatch(e)
        and e not in report
        and not any(p.fullmatch(e) for p in placed if len(p.pattern) > 40)
        and not (parts[e] and all(part in pool for part in parts[e]))
        and f"; {e}" not in pool
    ]
    assert not dead, "\n".join(dead)


def test_one_german_word_for_one_thing():
    for name, by_language in texts.catalogue().items():
        # A visit is a Termin, a measure a Messwert, a gait cycle a Doppelschritt.
        assert not re.search(r"Besuch|\bMaße?n?\b|Gangzykl", by_language["de"]), name


def test_a_check_of_one_of_several_recordings_has_its_name_in_german():
    for check, expected in {
        "residual_3d_cm (walk_a)": "Abweichung in 3D (cm) (walk_a)",
        "walking (walk (1))": "Gehen (walk (1))",
        "trial walk_a": "Aufnahme (walk_a)",
    }.items():
        assert texts.library("de", words.check_words(check)) == expected


def test_a_reason_in_brackets_is_german_too():
    reason = "its 90 % interval is wider than the range of healthy people"
    told = texts.library_words("de", f"Not known ({reason}): Work of the hip in stance")
    assert told.startswith("Nicht bekannt (das 90-%-Intervall ist breiter als")


def test_a_page_in_english_has_no_codes_either():
    reason = "no trial of walking at the pace 'self_selected' (there are: sit_to_stand; walking, fast)"
    said = "no recording of walking at the pace self-selected (there are: sit to stand; walking, fast)"
    assert texts.library_words("en", reason) == said
    held = "held at a limit in over 20% of the frames: {}"
    limit = held.format("neck_extension, hip_flexion_r")
    assert texts.library_words("en", limit) == held.format("extension of the neck, hip flexion right")
    assert texts.library_words("de", limit).endswith(": Extension des Halses, Hüftflexion rechts")
    camera = "the focal length is not measured ({}): pass --camera with a calibration (`pbl calibrate`)"
    assert texts.on_page("en", camera.format("guess: a lens; no distortion")).endswith(
        "; have the camera calibrated once"
    )
    assert texts.library_words("en", "tug: no complete gait cycle") == "tug: no complete gait cycle"  # tug.mp4
    assert texts.page_in("en", "<p>Camera intrinsics measured: " + camera.format("guess: a lens") + ".</p>").endswith(
        "; have the camera calibrated once.</p>"
    )
    empty = "choice of the person ran well and found nothing to go on with: No person was found in the video."
    assert texts.on_page("en", empty) == "No person was found in the video."
    assert {n for n in load_body().joint_names if texts.library_words("en", n) == n} == {*SLIDES}


def test_segments_of_wearable_sensors_are_words_on_pages():
    advice = "sensors move like other segments than stated, or sides were exchanged: {}"
    moved = ", ".join(f"{a} moves like {b}" for a, b in itertools.pairwise(SEGMENTS))
    for language, side in (
        ("en", "right thigh moves like left thigh"),
        ("de", "rechter Oberschenkel bewegt sich wie linker"),
    ):
        shown = str(texts.on_page(language, advice.format(moved)))
        assert side in shown
        assert not re.search(r"\w_[rl]\b|moves" if language == "de" else r"\w_[rl]\b", shown)


def test_no_text_of_a_page_names_a_command():
    said = [(name, t) for name, by_language in texts.catalogue().items() for t in by_language.values()]
    said = [s for s in said if s[0] != f"library.{s[1]}"]  # the library's own words, which `on_page` shortens
    assert len(said) > 500
    assert not [s for s in said if re.search(r"\bpbl [a-z]|--[a-z]", s[1])]
    for template in WEB.glob("templates/*.html"):
        assert not re.search(r"\bpbl [a-z]", template.read_text("utf-8")), template.name
    say = "Use the buttons of this page, or ask the person who runs this server."
    failed = "TrackedPersons failed (X); next: look at it, then "
    assert texts.on_page("en", f"{failed}pbl retry") == f"{failed}try again"
    assert texts.on_page("en", "TrackedPersons broke; look at it, then pbl retry") == (
        f"TrackedPersons broke; look at it. {say}"
    )
    assert texts.on_page("en", "give the height (--height-m), or <none>") == "give the height, or &lt;none&gt;"
    german = texts.on_page("de", "a. `pbl why` says more")
    assert german.startswith('<span lang="en">a.</span> Die Knöpfe')


def test_words_of_the_library_are_marked_where_they_stay_english():
    assert texts.library("de", "Cadence") == "Kadenz"
    reason = "walk1: no complete gait cycle; walk2: no complete gait cycle"  # of two recordings
    assert (
        texts.library("de", reason)
        == "walk1: kein vollständiger Doppelschritt; walk2: kein vollständiger Doppelschritt"
    )
    assert texts.library("en", "a < b") == "a &lt; b"
    assert texts.library("de", "a < b") == '<span lang="en">a &lt; b</span>'


def test_scripts_of_others_are_those_that_the_readme_names():
    rows = re.findall(r"^\| `([^`]+)` \|.*\| ([0-9a-f]{64}) \|$", (WEB / "vendor/README.md").read_text(), re.MULTILINE)
    found = {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in WEB.glob("vendor/*.min.*")}
    assert dict(rows) == found
    assert len(list(WEB.glob("vendor/*.LICENSE"))) == 3


def test_scripts_of_others_are_named_with_their_versions():
    """A page, or a script of ours, that names a vendored file names one that is there."""
    named = {n for f in [*_PAGES, *WEB.glob("static/*.js")] for n in re.findall(r"/vendor/([\w.-]+)", f.read_text())}
    assert {p.name for p in WEB.glob("vendor/*.min.*")} == named


def test_the_browsers_language():
    assert texts.language_of(None, "de-AT,de;q=0.9,en;q=0.5") == "de"
    assert texts.language_of(None, "fr;q=0.9, en;q=0.5, de;q=0.1") == "en"
    assert texts.language_of("de", "en") == "de"
    assert texts.language_of("xx", ";;;q=x,,") == "en"


def test_views_are_functions_and_classes_at_module_level():
    """What is nested in a function, such as a maker of routes, is out of reach of other modules and of tests."""
    kinds = (ast.FunctionDef, ast.AsyncFunctionDef)
    tops = [n for f in WEB.rglob("*.py") for n in ast.parse(f.read_text()).body if isinstance(n, kinds)]
    nested = [n.name for top in tops for n in ast.walk(top) if isinstance(n, kinds) and n is not top]
    assert len(tops) > 100
    assert len(nested) <= 5, nested
