"""The site of the documentation: `python -m docs_site` (`make docs`) builds it from docs/, the READMEs and the code."""

from ._build import BUILT, BuildError, build, pages, stage
