"""The review page (`pbl web`): find a visit, look at its recordings, decide, in a browser. docs/web.md describes it."""

from .app import create_app
from .folder import ResultsFolder
from .serve import Where, serve
from .site import Options
