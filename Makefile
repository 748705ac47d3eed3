# Two targets do it all on a fresh machine: `make quickstart` and `make test`; `make docs` builds the site, `make article` a PDF.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin

unexport PYTHONDONTWRITEBYTECODE  # else each of some hundred processes compiles the texts of all packages that it imports

.PHONY: quickstart test test-fast test-long test-jax lint docs article clean

.venv/.ok: pyproject.toml setup.py constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip uninstall -q -y pharos 2>/dev/null  # the name of this distribution before it was pharos-rl
	$(BIN)/python -m pip install -q --no-compile -e ".[dev]" -c constraints.txt
	@touch $@

quickstart: .venv/.ok
	$(BIN)/python scripts/quickstart.py

test: .venv/.ok
	$(BIN)/python -m pytest -n auto --dist worksteal -m "not long"

test-fast: .venv/.ok
	$(BIN)/python -m pytest -n auto --dist worksteal -m "not slow and not long"

test-long: .venv/.ok
	$(BIN)/python -m pytest -n auto --dist worksteal -m long

# JAX has an environment of its own: gymnax wants an older Gymnasium than the one that everything else is tested with.
.venv-jax/.ok: pyproject.toml setup.py
	test -x .venv-jax/bin/python || $(PYTHON) -m venv .venv-jax
	.venv-jax/bin/python -m pip install -q --no-compile -e ".[jax,study]" pgx pytest pytest-xdist hypothesis
	@touch $@

test-jax: .venv-jax/.ok
	.venv-jax/bin/python -m pytest -n auto --dist worksteal -k "jax or gymnax" tests/importers/test_jax_stepping.py \
		tests/interaction/test_gymnax.py tests/benchmark/test_jax_agents.py

lint: .venv/.ok
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

.venv/.docs: .venv/.ok
	$(BIN)/python -m pip install -q --no-compile -e ".[docs]" -c constraints.txt
	@touch $@

docs: .venv/.docs
	$(BIN)/python scripts/build_site.py

article:
	$(PYTHON) scripts/article_latex.py

clean:
	rm -rf .venv .venv-jax build dist site *.egg-info .pytest_cache .mypy_cache .ruff_cache
