# Two commands for a fresh machine: `make train` and `make test`.
PYTHON ?= python3.11
ifeq (, $(shell command -v $(PYTHON) 2>/dev/null))
PYTHON := python3
endif
BIN := .venv/bin
ARGS ?=

.PHONY: setup train test coverage test-slow encoders format clean

setup: .venv/.installed

.venv/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@

train: setup
	$(BIN)/navaclq train --run runs/main --minutes 10 --seed 1 --eval short $(ARGS)

test: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	OMP_NUM_THREADS=1 $(BIN)/pytest -m "not slow" -n 2 $(ARGS)

# The same tests with what they cover, which takes two thirds longer.
coverage: setup
	$(BIN)/pytest -m "not slow" --cov --cov-report=term $(ARGS)

test-slow: setup
	$(BIN)/pytest -m slow --timeout 3600 $(ARGS)

# Both shipped encoders from nothing; an interrupted one goes on where it was.
encoders: setup
	$(BIN)/navaclq pretrain --run runs/eyes-fast --frames runs/frames --seed 1 --out common/encoders/fast
	$(BIN)/navaclq pretrain --run runs/eyes-paper --frames runs/frames --seed 1 --preset paper --epochs 10 \
		--out common/encoders/paper

format: setup
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf .venv build *.egg-info .mypy_cache .ruff_cache .pytest_cache .coverage
