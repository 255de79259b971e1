# Common commands. `make demo` and `make test` create .venv if it does not exist.
PYTHON ?= python3
BIN := .venv/bin
TESTS ?= not slow

.PHONY: demo test check bench difficulty docs notebooks pins clean

# torch's default build includes CUDA, 5 GB of 7 GB. A torch that .venv can import is kept: one installed there
# beforehand (e.g. the CPU build), or that of the system (make VENV_ARGS=--system-site-packages). A torch installed by
# make is updated with constraints.txt.
TORCH := torch|torchvision|triton|nvidia-[a-z0-9-]+|cuda-[a-z]+
KEEP := import torch, torchvision, sys; sys.exit(tuple(map(int, torch.__version__.split(".")[:2])) < (2, 11))

.venv/ready: constraints.txt pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV_ARGS) .venv
	if ! { test -e $@ && grep -q '^torch==' .venv/constraints.txt; } && $(BIN)/python -c '$(KEEP)' 2> /dev/null; then \
	  awk '/^[a-z]/ { skip = /^($(TORCH))==/ } !skip' constraints.txt > .venv/constraints.txt; \
	else cp constraints.txt .venv/; fi
	$(BIN)/python -m pip install --quiet --no-deps --require-hashes -r .venv/constraints.txt
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	touch $@

demo: .venv/ready  ## pre-train, probe and report on simulated data (minutes on two cores)
	$(BIN)/mvitac demo --out runs/demo

test: .venv/ready  ## the tests, on all cores; TESTS= runs the slow ones, too, as .ci/run does
	$(BIN)/python -m pytest --numprocesses auto --maxprocesses 8 --dist worksteal -m "$(TESTS)"

check: .venv/ready  ## linter, formatter, types and import contract
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/pyright --pythonpath $(BIN)/python

pins:  ## update constraints.txt; needs uv on the PATH
	uv pip compile pyproject.toml --extra dev --universal --python-version 3.11 --generate-hashes \
	  --no-emit-index-url --no-header --no-annotate --output-file constraints.txt

bench: .venv/ready  ## speed compared with the bare networks and with typical research code (docs/speed.md)
	$(BIN)/python -m benchmarks.speed

difficulty: .venv/ready  ## check the design rule of the simulator (takes long; docs/simulator.md)
	$(BIN)/python -m benchmarks.difficulty materials

docs: .venv/ready  ## build the documentation in site/ (open site/index.html); warnings are errors
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet

notebooks: .venv/ready  ## the tutorials as notebooks beside their pages (not kept in the repository)
	$(BIN)/jupytext --quiet --to ipynb docs/tutorials/[!i]*.md

clean:
	rm -rf .venv build dist site .pytest_cache .ruff_cache
