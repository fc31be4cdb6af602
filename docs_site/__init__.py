"""The site of the documentation: `python -m docs_site` (`make docs`) builds it from docs/, the rooms' READMEs and the code."""

from ._build import BUILT, build, stage

__all__ = ["BUILT", "build", "stage"]
