# Shorthands for work in a checkout; README's commands need none of them.
PYTHON ?= python3
VENV ?= .venv

.PHONY: install test lint demo bench golden ci clean

install: $(VENV)/installed
$(VENV)/installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/pip install -q -e '.[test,intel]'
	touch $@

test: install            ## all tests on PoCL
	$(VENV)/bin/pytest -n 2
lint: install
	$(VENV)/bin/ruff check .
demo: install
	$(VENV)/bin/clsurf demo
bench: install           ## figures of this machine, as JSON in bench/results
	$(VENV)/bin/clsurf bench build --json bench/results/build.json
	$(VENV)/bin/clsurf bench tiles --json bench/results/tiles.json
	$(VENV)/bin/clsurf bench normals --json bench/results/normals.json
golden: install          ## regenerate the golden pictures after looking at what changed
	CLSURF_GOLDEN=write $(VENV)/bin/pytest tests/test_render_golden.py
ci:
	.ci/run
clean:
	rm -rf $(VENV) dist build-out tests/out
