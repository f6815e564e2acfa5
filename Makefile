# `make demo` and `make test` do all the set-up they need, on a bare Debian or Ubuntu machine with Python and a network.

PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
# PyTorch's build without CUDA, some gigabytes smaller; TORCH=torch takes what PyPI has.
TORCH  ?= 'torch==2.13.0' --extra-index-url https://download.pytorch.org/whl/cpu
READY  := $(VENV)/.ready
# Processes that run tests, one core each; each takes about 1 GB of memory.
WORKERS ?= auto
# Python keeps what it compiled, even where the environment says otherwise: tests start many processes.
export PYTHONDONTWRITEBYTECODE :=
PYTEST := -m pytest -n $(WORKERS) --maxprocesses 8 --dist worksteal

.PHONY: setup demo test test-all lint coverage validation docs maps clean

setup: $(READY)

# The environment, the package in it, and an LLVM runtime for its CPU back end. The second stamp makes a change of
# the dependencies install them again.
$(READY): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' \
	  || { echo "Python 3.10 or newer is needed; give one with make PYTHON=/path/to/python3"; exit 2; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || $(MAKE) --no-print-directory venv-package
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --retries 0 $(TORCH)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[test]'
	$(BIN)/thermorender doctor --install
	@touch $(READY)

# Debian and Ubuntu keep venv in a package of its own.
.PHONY: venv-package
venv-package:
	@if [ "$$(id -u)" = 0 ]; then apt-get update -q && apt-get install -y -q python3-venv; \
	 elif sudo -n true 2>/dev/null; then sudo apt-get update -q && sudo apt-get install -y -q python3-venv; \
	 else echo "Python's venv module is missing; install it with: sudo apt-get install python3-venv"; exit 2; fi

demo: $(READY)
	rm -rf out/demo
	$(BIN)/thermorender demo -o out/demo
	@echo '. $(BIN)/activate   # in each new shell'

# All but the tests marked `slow`: six minutes on two cores.
test: $(READY)
	$(BIN)/python $(PYTEST) -m "not slow"

# A browser for the tests of the studio, which are skipped without one.
.PHONY: browser
browser:
	@command -v chromium >/dev/null || { \
	   if [ "$$(id -u)" = 0 ]; then apt-get update -q && apt-get install -y -q chromium; \
	   elif sudo -n true 2>/dev/null; then sudo apt-get update -q && sudo apt-get install -y -q chromium; fi; } \
	  || echo "Chromium could not be installed; the tests of the studio are skipped"

# Every test, and more examples of each random one; prints the ten slowest. 40 minutes on two cores.
test-all: $(READY) browser
	$(BIN)/python $(PYTEST) --hypothesis-profile slow --durations 10

# Rules, format and types. Another release of ruff may format differently; .pre-commit-config.yaml names the same one.
lint: $(READY)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check 'ruff==0.17.6' 'mypy>=1.11'
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# Line coverage of each room (folder of the package) by `make test`, processes that tests start included; fails
# below 85 %.
coverage: $(READY)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check 'coverage>=7.10'
	$(BIN)/python -m coverage erase
	$(BIN)/python -m coverage run $(PYTEST) -m "not slow"
	$(BIN)/python -m coverage combine --quiet
	$(BIN)/python -m coverage json --quiet -o coverage.json
	$(BIN)/python tests/coverage_of_rooms.py coverage.json

# Every study without results is run, which takes hours; then one page of verdicts is written: validation/index.html.
validation: $(READY)
	$(BIN)/python -m validation

# The pages of docs/, with the notebooks of examples/ executed; a warning is an error.
docs: $(READY)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[docs]'
	$(BIN)/python -m sphinx -W --keep-going -b html docs docs/_build/html
	@echo "open docs/_build/html/index.html"

# Makes the shipped learned maps again: the standard campaign is rendered, which takes two hours of one core, and each
# method trained on it, compact+ and pix2pix for another 76 and 45 minutes of one core. What is there of the campaign
# and of the trainings is kept.
MAPS := thermorender/learned/maps
maps: $(READY)
	mkdir -p $(MAPS)
	$(BIN)/thermorender dataset -o out/campaign --resume
	$(BIN)/thermorender train correlation-9to1 out/campaign -o $(MAPS)/procedural-9to1.npz
	$(BIN)/thermorender train palette out/campaign -o $(MAPS)/procedural-palette.npz
	$(BIN)/thermorender train trees out/campaign -o $(MAPS)/procedural-trees.npz
	$(BIN)/thermorender train correlation+ out/campaign -o $(MAPS)/procedural-correlation+.npz
	$(BIN)/thermorender train trees+ out/campaign -o $(MAPS)/procedural-trees+.npz
	$(BIN)/thermorender train compact+ out/campaign -o $(MAPS)/procedural-compact+.npz \
	  --run out/compact+.run --resume --set crops=40000 --set every=2000 --set tolerance_mk=15
	$(BIN)/thermorender train pix2pix out/campaign -o $(MAPS)/procedural-pix2pix.npz \
	  --run out/pix2pix.run --resume --set width=16 --set batch=4 --set crops=60000 --set every=3000 \
	  --set tolerance_mk=15

clean:
	rm -rf $(VENV) out build dist docs/_build
