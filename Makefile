# Everything a newcomer needs: `make demo` and `make test` set up .venv by themselves.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: demo test check bench difficulty docs notebooks pictures pins clean

# torch brings CUDA, 5 of the 7 GB. A torch that .venv can import is kept: one that was installed there first (the CPU's),
# or the system's, with make VENV_ARGS=--system-site-packages. One that make installed itself follows constraints.txt.
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

demo: .venv/ready  ## the main job end to end, on simulated data (minutes on two cores)
	$(BIN)/mvitac demo --out runs/demo

test: .venv/ready  ## the test suite, on all cores
	$(BIN)/python -m pytest --numprocesses auto --maxprocesses 8 --dist worksteal

check: .venv/ready  ## lint, format, types, import contract
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/pyright --pythonpath $(BIN)/python

pins:  ## write constraints.txt anew: needs uv on the PATH
	uv pip compile pyproject.toml --extra dev --universal --python-version 3.11 --generate-hashes \
	  --no-emit-index-url --no-header --no-annotate --output-file constraints.txt

bench: .venv/ready  ## speed against the bare networks and the typical research code (docs/speed.md)
	$(BIN)/python -m benchmarks.speed

difficulty: .venv/ready  ## the simulator's difficulty rule, measured anew (long)
	$(BIN)/python -m benchmarks.difficulty materials

docs: .venv/ready  ## the documentation site, into site/ (open site/index.html); any warning is an error
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet

notebooks: .venv/ready  ## write the tutorials' notebooks anew from their pages
	$(BIN)/jupytext --quiet --update --to ipynb docs/tutorials/[!i]*.md

pictures: .venv/ready  ## draw the docs' picture of the simulator again
	$(BIN)/mvitac data sheet materials --out docs/materials.png

clean:
	rm -rf .venv build dist site .pytest_cache .ruff_cache
