# make demo: the main job on a real video in an embedded database.   make test: the tests.   All install what they need.

VENV   := .venv
BIN    := $(VENV)/bin
RUNS   := $(VENV)/.runs# what a worker needs: the lock of its image
READY  := $(VENV)/.installed# that and what tests need
FITS   := -B -c 'from pbl_pipeline.interpreter import require; require()'
# The first that fits. If none does, python3, which is then refused.
PYTHON ?= $(shell for p in python3.11 python3.12 python3.13; do $$p $(FITS) 2>/dev/null && break; p=python3; done; echo $$p)
ROOM   := 2500# MB: 1,300 for the environment of the demo, the rest for what pip downloads and for tests
OUT    ?= pbl_demo
JOBS   ?= 3# test processes, a file of tests at a time, in the order of the folders: the longest come first. On two
# cores two of them leave a fifth of the time idle: they wait for browsers, phones and processes that end
# Whatever the shell says, compiled modules are kept: tests start many processes that import them.
PYTEST := PYTHONDONTWRITEBYTECODE= $(BIN)/pytest --numprocesses $(JOBS) --dist loadfile --no-loadscope-reorder

.PHONY: demo docs test test-fast test-newest lint format lock dist clean help

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

test-newest: $(READY) ## wheel, demo and fast tests on the newest other Python of this machine; PYTHONS="a b" names some
	$(BIN)/python -m tests.other_python $(PYTHONS)

lint: $(READY)  ## style, formatting and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

format: $(READY) ## rewrite the source in the project's format
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

LOCK := $(BIN)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-emit-index-url \
	  --no-emit-find-links --upgrade --custom-compile-command "make lock"

IMAGE := workers/deploy/requirements-cpu.lock
OF_IMAGE := --extra s3 --extra figures --extra depth# the extras of what workers do
# Only what that lock lacks, in its versions: the longer locks begin with `-r`. uv lists the others after an empty line.
BEYOND = --constraint $(IMAGE) $$(sed -n 's/^\([a-z0-9._-]*\)==.*/--no-emit-package \1/p' $(IMAGE))

lock: $(READY)  ## choose the newest allowed version of every dependency and write requirements.lock and the images' three
	$(BIN)/pip install --quiet uv
	$(LOCK) $(OF_IMAGE) --output-file $(IMAGE) pyproject.toml
	$(LOCK) --extra dev $(BEYOND) --output-file requirements.lock pyproject.toml
	$(LOCK) $(OF_IMAGE) --extra gpu $(BEYOND) --output-file workers/deploy/requirements-gpu.lock pyproject.toml
	sed -i -e '1i -r $(IMAGE)' -e '/^$$/,$$d' requirements.lock
	sed -i -e '1i -r $(notdir $(IMAGE))' -e '/^$$/,$$d' workers/deploy/requirements-gpu.lock
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
$(RUNS): pyproject.toml $(IMAGE)
	@command -v $(PYTHON) >/dev/null || { echo "PYTHON_UNSUPPORTED: there is no $(PYTHON) on this machine. Python 3.11 or \
	newer of 64 bits is needed: apt-get install python3-venv, or make demo PYTHON=/path/to/python3.11"; exit 1; }
	@$(PYTHON) $(FITS)
	@free=$$(df -Pm . | awk 'NR == 2 {print $$4}'); test -x $(BIN)/pbl || test "$$free" -ge $(ROOM) || { \
	  echo "FILE_UNWRITABLE: $$free MB are free on this disk, $(VENV) needs $(ROOM) MB: free some, or move the checkout"; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { \
	  echo "installing Debian's python3-venv (needed once)"; \
	  sudo=$$(test "$$(id -u)" = 0 || echo sudo); $$sudo apt-get update -qq && \
	  $$sudo env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends python3-venv >/dev/null; } || { \
	  echo "PACKAGE_MISSING: $(PYTHON) has no venv, and apt did not install it (above). As root: apt-get install python3-venv," \
	    "or without root: make demo PYTHON=/path/to/python3.11 of uv, pyenv or conda"; exit 1; }
	@test ! -x $(BIN)/python || $(BIN)/python $(FITS)
	@$(BIN)/python -c 'import pip' 2>/dev/null || $(PYTHON) -m venv $(VENV)
	@echo "installing the locked dependencies into $(VENV) (some minutes the first time)"
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -r $(IMAGE)
	@$(BIN)/python -m compileall -qq -j 0 $(VENV)/lib || true # pip compiles on one core
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --editable .
	@touch $(RUNS)

$(READY): $(RUNS) requirements.lock
	@echo "installing what the tests need"
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -r requirements.lock
	@touch $(READY)

clean:          ## remove the virtual environment and the demo's output; the database and the cache stay
	rm -rf $(VENV) $(OUT) build .pytest_cache .ruff_cache
