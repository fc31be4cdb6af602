"""A coded error stays one from the job to the page: as data in its row, said in the reader's language."""

import ast
import functools
import json
import pickle
from string import Formatter

import numpy as np
import pytest
from datajoint.jobs import ERROR_MESSAGE_LENGTH, TRUNCATION_APPENDIX

from pbl_pipeline import texts
from pbl_pipeline.assumptions import check_size
from pbl_pipeline.errors import PblError, Said, joined, said
from pbl_pipeline.gait._angles import LEG_ANGLES
from pbl_schemas.job_errors import as_text, error_code, error_message, stored_error
from tests.source import PACKAGES, files, nodes

KEY = {"video_id": 7}


def parts(error: PblError) -> tuple[str, ...]:
    return error.code, error.found, error.expected, error.next_step


def stored(error: PblError) -> PblError:
    """The error as the row of a job gives it back."""
    message = error_message(error, "Keypoints", KEY)
    assert len(message) <= ERROR_MESSAGE_LENGTH
    assert error_code(message) == error.code
    return stored_error(message)


def test_an_error_is_the_same_behind_the_row_of_its_job():
    of_values = said("trial {name}: {s:.2f} s of {n}", name="walk", s=np.float64(0.456), n=np.int64(3))
    for found in (
        of_values,
        "two lines:\n  next: is in the second\n  found: too",
        'quotes " and \\ and {braces}',
        "é∞\x1b",
    ):
        error = PblError("FIT_INPUT", found, said("at least {s:.1f} s", s=1), "look at it", key="walk")
        back = stored(error)
        assert parts(back)[:1] + parts(back)[2:] == parts(error)[:1] + parts(error)[2:]
        assert back.found == found.replace("\x1b", "\\x1b")
        assert back.key == "walk"
        assert str(back) == str(error)
    back = stored(PblError("FIT_INPUT", of_values, "x", "y")).found
    assert isinstance(back, Said)
    assert (back.template, back.values) == (of_values.template, {"name": "walk", "s": 0.456, "n": 3})
    assert pickle.loads(pickle.dumps(back)).values == back.values


@pytest.mark.parametrize("letter", ["x", '"', "\\", "ä", "\n"])
def test_no_error_is_too_long_for_its_row(letter: str):
    long = letter * 3000
    found = said("the file {name} is {n} s long", name=long, n=3)
    for error in (PblError("VIDEO_DAMAGED", long, long, long, key=long), PblError("FIT_INPUT", found, "x", "y")):
        back = stored(error)
        assert back.code == error.code
        assert back.found
        assert back.next_step
    assert len(as_text(PblError("VIDEO_DAMAGED", long, long, long, key=long), 980)) <= 980


def test_texts_of_earlier_versions_and_of_datajoint_are_read():
    error = PblError("VIDEO_DAMAGED", "3 pictures", "none", "copy it again", key="a\n  next:     something else")
    for text in (str(error), f"PblError: {error}"):
        assert parts(stored_error(text)) == parts(error)
    assert parts(stored_error("VIDEO_DAMAGED: 3 pictures"))[:2] == ("VIDEO_DAMAGED", "3 pictures")
    unknown = stored_error('PLATE_SATURATED: {"found": "6 kN", "expected": "5 kN", "next_step": "record again"}')
    assert parts(unknown) == ("INTERNAL", "6 kN", "5 kN", "record again")
    for odd in (
        '{"says": "{x"}',
        '{"says": "{x}", "of": {}}',
        '{"says": "{x.__class__}", "of": {"x": 1}}',
        "[1]",
        "null",
    ):
        assert stored_error(f'FIT_INPUT: {{"found": {odd}}}').code == "FIT_INPUT"
        assert "<class" not in stored_error(f'FIT_INPUT: {{"found": {odd}}}').found
    for text in ("KeyboardInterrupt", "DataJointError: fetch1 found nothing", "NO_SUCH_CODE: {}", "INTERNAL: [1]"):
        assert stored_error(text).code == "INTERNAL"
    cut = error_message(PblError("VIDEO_DAMAGED", "x" * 500, "y", "z"), "Keypoints", KEY)[:300] + TRUNCATION_APPENDIX
    assert stored_error(cut).code == "VIDEO_DAMAGED"
    assert stored_error(cut).found.endswith(TRUNCATION_APPENDIX)


def refuse(name: str, found: str, expected: str, next_step: str) -> PblError:
    return PblError("FIT_INPUT", said("trial {name}: {found}", name=name, found=found), expected, next_step)


def test_a_text_with_values_is_said_in_the_language_of_the_page():
    with pytest.raises(PblError) as error:
        check_size(1000.0, functools.partial(refuse, "a: b"))
    back = stored(error.value)
    assert back.found == "trial a: b: a body 1000 times that of an adult, such as millimetres read as metres"
    german = "Aufnahme a: b: ein Körper vom 1000-Fachen der Größe eines Erwachsenen, etwa mit Millimetern, die als"
    for text in (back.found, back.short()):
        assert texts.on_page("de", text).startswith(german)
        assert texts.on_page("en", text) == back.found
    assert back.short().startswith("FIT_INPUT: ")
    lasts = said("the whole video lasts {s:.2f} s", s=0.5)
    assert "0,50" in texts.on_page("de", lasts)
    # Texts that are joined, or stand in another, are said too, and a page that knows none of them says so.
    both = joined(["", back.found, "not computed yet", "a {brace}"], "; ")
    assert both == f"{back.found}; not computed yet; a {{brace}}"
    assert texts.on_page("de", both).endswith(f"; {texts.library_words('de', 'not computed yet')}; a {{brace}}")
    assert not joined([])
    # Words in a value are a name, such as of a recording, not a template, a tag, a word or a command.
    named = said("trial {name}: NaN or infinite points with confidence above 0", name="fast")
    assert texts.on_page("de", named).startswith("Aufnahme fast:")
    assert "/data/pbl study" in texts.on_page("de", said("no file at {path}", path="/data/pbl study"))
    assert "&lt;b&gt;{n}" in texts.on_page("de", said("no file at {path}", path="<b>{n}"))


def templates() -> set[str]:
    """Every text that the code says with values; each call has the values of its text."""
    found = set()
    for path in files(*PACKAGES):
        for node in nodes(path):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "said":
                if not isinstance(node.args[0], ast.Constant):
                    continue  # of several texts, or one that is handed on
                found.add(text := str(node.args[0].value))
                places = {field for _, field, _, _ in Formatter().parse(text) if field}
                assert places == {k.arg for k in node.keywords}, text
    return found


def test_what_is_said_with_values_has_its_german_and_is_said():
    every = templates()
    assert len(every) > 40
    filled = [said(t, **{f: 0.5 for _, f, _, _ in Formatter().parse(t) if f}) for t in every]
    untold = [t.template for t in filled if "<span" in texts.on_page("de", t)]
    assert not untold
    written = {str(n.value) for path in files(*PACKAGES) for n in nodes(path) if isinstance(n, ast.Constant)}
    plain = {texts.bare(t) for t in every | written} | {name.replace("_", " ") for name in LEG_ANGLES}
    assert not [n for n in texts.catalogue() if n.startswith("said.") and n.removeprefix("said.") not in plain]
    assert json.loads(json.dumps(said("{n} frames", n=np.int32(3)).data())) == {"says": "{n} frames", "of": {"n": 3}}
