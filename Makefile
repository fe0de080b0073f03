# Two commands do all the set-up: `make demo` and `make test`. Both create .venv from the pinned constraints.txt.

PYTHON ?= $(shell for p in python3.13 python3.12 python3.11 python3; do \
	command -v $$p >/dev/null 2>&1 && $$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' && { echo $$p; break; }; done)
BIN := .venv/bin
INSTALLED := .venv/installed
QUIET_PIP := --disable-pip-version-check --quiet

.PHONY: demo test lint mutants install models clean

demo: models  ## the main job on the bundled clip; prints where the avatar, the video and the report are
	OMP_WAIT_POLICY=passive $(BIN)/ahoy run ahoy_core/assets/demo.mp4 --out out/demo

# One process more than cores, since some tests mostly wait. Where bytecode is switched off, it is switched on: hundreds of
# processes start, and each would compile our modules anew.
test: models lint  ## style, types, layers, then the whole suite
	PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 OMP_WAIT_POLICY=passive \
		$(BIN)/pytest --dist loadfile --no-loadscope-reorder --durations 25 \
		--numprocesses $$($(BIN)/python -c 'import os; print((os.cpu_count() or 1) + 1)')

lint: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

mutants: $(INSTALLED)  ## breaks the rasterizer on purpose, once for each hard case, and checks that its test notices
	$(BIN)/python -m tests.mutants.run

models: $(INSTALLED)  ## the landmark networks: pulled once, verified by hash
	$(BIN)/ahoy models pull

install: $(INSTALLED)

$(INSTALLED): pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "expected Python 3.11 or newer on PATH, got none; install it or say make PYTHON=/path/to/python3"; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/pip install $(QUIET_PIP) --constraint constraints.txt --editable '.[dev]'
	touch $@

clean:
	rm -rf .venv out build
