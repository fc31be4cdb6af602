# make demo: the main job on a real video in an embedded database.   make test: the tests.   All install what they need.

VENV   := .venv
BIN    := $(VENV)/bin
RUNS   := $(VENV)/.runs# what a worker needs: the lock of its image
READY  := $(VENV)/.installed# that and what tests need
PYTHON ?= $(shell for p in python3.11 python3.12 python3.13 python3; do \
            if command -v $$p >/dev/null && $$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; \
            then echo $$p; break; fi; done)
OUT    ?= pbl_demo
JOBS   ?= 2# test processes, a file of tests at a time, in the order of the folders: the longest come first
# Whatever the shell says, compiled modules are kept: tests start many processes that import them.
PYTEST := PYTHONDONTWRITEBYTECODE= $(BIN)/pytest --numprocesses $(JOBS) --dist loadfile --no-loadscope-reorder

.PHONY: demo docs test test-fast lint format lock dist clean help

help:           ## what can be made
	@grep -E '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 16

demo: $(RUNS)   ## put the demo recording through every table and show the result
	$(BIN)/pbl demo --out $(OUT)

docs: $(READY)  ## the site of the documentation: build/docs/site/index.html
	$(BIN)/python -m docs_site

test: $(READY)  ## the tests
	$(PYTEST)

test-fast: $(READY) ## the tests that take 90 s on two idle cores: no database, no fit, no network over a video
	$(PYTEST) tests -m "not slow and not database and not browser and not needs_extra"

lint: $(READY)  ## style, formatting and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

format: $(READY) ## rewrite the source in the project's format
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

LOCK := $(BIN)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-emit-index-url \
	  --no-emit-find-links --upgrade --custom-compile-command "make lock"

lock: $(READY)  ## choose the newest allowed version of every dependency and write requirements.lock and the images' three
	$(BIN)/pip install --quiet uv
	$(LOCK) --extra dev --output-file requirements.lock pyproject.toml
	$(LOCK) --extra s3 --extra figures --output-file workers/deploy/requirements-cpu.lock pyproject.toml
	$(LOCK) --extra s3 --extra figures --extra gpu --output-file workers/deploy/requirements-gpu.lock pyproject.toml
	$(BIN)/python -c 'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["build-system"]["requires"])' \
	  | $(LOCK) --output-file workers/deploy/requirements-build.lock -

FILES ?=# address of the files of the tagged commit, https://HOST/OWNER/NAME/blob/TAG: makes the links of README absolute
TOOLS := build/dist/tools/bin

dist: $(READY)  ## source archive and wheel of the commit, checked: dist/
	rm -rf build/dist dist && mkdir -p build/dist/source
	$(BIN)/python -m venv build/dist/tools
	$(TOOLS)/pip install --quiet --disable-pip-version-check build twine cffconvert
	git archive HEAD | tar -x -C build/dist/source
	test -z "$(FILES)" || sed -E -i -e 's#(!\[[^]]*\]\()([^:)]+)\)#\1$(subst /blob/,/raw/,$(FILES))/\2)#g' \
	  -e 's#([^!]\[[^]]*\]\(|^\[[^]]*\]\()([^:)]+)\)#\1$(FILES)/\2)#g' build/dist/source/README.md
	PBL_COMMIT=$$(git rev-parse --short=12 HEAD) $(TOOLS)/python -m build --outdir dist build/dist/source
	$(TOOLS)/twine check --strict dist/*
	$(TOOLS)/cffconvert --validate --infile build/dist/source/CITATION.cff

# Debian splits `venv` off; without it the environment cannot hold pip, so it is installed once (root or sudo).
$(RUNS): pyproject.toml workers/deploy/requirements-cpu.lock
	@test -n "$(PYTHON)" || { echo "Python 3.11 or newer is needed: apt-get install python3"; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { \
	  echo "installing Debian's python3-venv (needed once)"; \
	  sudo=$$(test "$$(id -u)" = 0 || echo sudo); $$sudo apt-get update -qq && \
	  $$sudo env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends python3-venv >/dev/null; }
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@echo "installing the locked dependencies into $(VENV) (some minutes the first time)"
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -r workers/deploy/requirements-cpu.lock
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --editable .
	@touch $(RUNS)

$(READY): $(RUNS) requirements.lock
	@echo "installing what the tests need"
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.lock
	@touch $(READY)

clean:          ## remove the virtual environment and the demo's output; the database and the cache stay
	rm -rf $(VENV) $(OUT) build .pytest_cache .ruff_cache
