# Everything a newcomer needs: each target sets up what it needs first.
PYTHON ?= python3
BIN := .venv/bin
METHODS := volumetric/nerf,volumetric/hash,splatting/gaussians

.PHONY: env compare picture matrix prior bench notebooks test test-triton test-notebooks fuzz sabotage slow check clean

env: .venv/.ready  ## create .venv and install invgraphics with all it needs

.venv/.ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet -c constraints.txt -e ".[dev,llvm]"
	touch $@

compare: env  ## the main job: three families on one scene under one budget, and a report
	$(BIN)/invgraphics compare bricks --methods $(METHODS) --budget 60s --out reports/compare-bricks

picture: compare  ## renew the README's pictures
	$(BIN)/python docs/picture.py reports/compare-bricks docs/compare-bricks.png
	$(BIN)/python docs/example.py docs/example.png

matrix: env  ## every method on one scene, a minute each (an hour in all), as a report and as the README's table of pictures
	$(BIN)/invgraphics compare bricks --methods all --budget 60s --out reports/compare-all-bricks
	$(BIN)/invgraphics report reports/compare-all-bricks --public --out reports/matrix
	$(BIN)/python docs/matrix.py reports/compare-all-bricks docs/matrix.png

prior: env  ## priors over chairs by three conditionings, and what they are worth from 1 to 8 views (about two hours): out/prior-inferred
	$(BIN)/invgraphics ablate prior --out out/prior
	$(BIN)/invgraphics infer out/prior --views 1,2,4,8 --no-prior 400steps

bench: env  ## every kernel against the reference and the machine's limits: reports/bench
	$(BIN)/invgraphics bench

notebooks: env  ## run the notebooks and write them as pages: reports/notebooks
	$(BIN)/python -m pip install --quiet -c constraints.txt -e ".[notebooks]"
	$(BIN)/python notebooks/render.py

test: env  ## compile the kernels, once for all processes (2 minutes), and run the test suite (11 to 13 on 2 cores)
	$(BIN)/invgraphics doctor --warm-up
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

test-triton: env  ## install triton (0.6 GB) and test the GPU's kernels without one: interpreted against the reference, and compiled
	$(BIN)/python -m pip install --quiet -c constraints.txt "triton>=3.8; sys_platform == 'linux'"
	$(BIN)/python -m pytest tests/kernels/test_cuda_interpreted.py

test-notebooks: env  ## every notebook at a small size, and the numbers it prints
	$(BIN)/python -m pip install --quiet -c constraints.txt -e ".[notebooks]"
	OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 -m slow tests/notebooks

fuzz: env  ## 5000 damaged inputs of every reader; INVGRAPHICS_FUZZ_SEED repeats those of a day
	INVGRAPHICS_FUZZ=$${INVGRAPHICS_FUZZ:-5000} $(BIN)/python -m pytest -s tests/fuzz

sabotage: env  ## faults at 200 random moments of commands, and with ray a lost node; INVGRAPHICS_SABOTAGE_SEED repeats a day's
	INVGRAPHICS_SABOTAGE=$${INVGRAPHICS_SABOTAGE:-200} $(BIN)/python -m pytest -s tests/sabotage
	$(BIN)/python -m pytest -m slow tests/experiments/test_executors_slow.py -k lost_node

slow: env  ## the longer checks
	$(BIN)/python -m pytest -m slow

check: env  ## lint, format, types, import contract
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports

clean:  ## remove the environment and what the tools cached
	rm -rf .venv .pytest_cache .ruff_cache .import_linter_cache
