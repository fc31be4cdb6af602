"""Figures of the docs: which tables have kept what their command printed, and record it.

python -m research.figures                  # tables of figures by page, and what printed each
python -m research.figures record NAME...   # run the command of NAME and keep what it printed
"""

import sys

import click

from research.figures import commands, pages, passages, printed, record

if sys.argv[1:2] == ["record"]:
    for name in sys.argv[2:] or commands():
        record(name)
        click.echo(f"{name}: recorded")
else:
    kept = printed()
    for page in pages():
        for passage in passages(page):
            if passage.name or passage.is_table_of_figures:
                entry = kept.get(passage.name, {})
                what = f"{passage.name}, {entry.get('day', 'not recorded')}" if passage.name else "-"
                click.echo(f"{page}: {passage.text.splitlines()[0][:60]}: {what}")
