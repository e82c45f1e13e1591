# What to do with a fresh copy of this project:
#   make demo    photos of a desk -> poses, field, numbers, depth maps and a flight around it, in demo/
#   make test    what CI runs: format, lint, types, tests
#   make test-slow    the long tests, and 2,000 examples of every property
#   make release    wheel and sdist in dist/, installed in a fresh environment and tried on six photos there
#   make figures DATA=folder    measures docs/figures.md on captures, for hours; it can be stopped and started again
#   make clean   remove .venv, demo/ and all caches
# Demo and test make .venv first, once. With a Python of your choice: make test PYTHON=/opt/python/bin/python3.13

PYTHON =
BIN = .venv/bin
# Python compiles a module when it is first imported: to compile all of torch at once takes 20 s longer.
PIP_INSTALL = $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test test-slow release figures clean

demo: .venv/installed
	$(BIN)/nerfcli run sample_scenes/desk/images -o demo --budget 90s --downscale 2
	@printf '%s\n' '' 'Have a look at:' \
	    '  demo/run/renders/orbit-conditional-z-splats/rgb.mp4     a flight around the desk' \
	    '  demo/run/renders/orbit-conditional-z-splats/depth.mp4   the same flight in depth' \
	    '  demo/run/renders/test-conditional-z/             held-out views: rgb/, depth/, opacity/' \
	    '  demo/run/metrics.json                            how close these are to the photos' \
	    '  demo/scene/poses_report.json                     what became of each photo'

test: .venv/installed-dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	# Types are checked beside the rest. The CPU kernels are compiled once: two test processes would both do it.
	@$(BIN)/pyrefly check --progress-bar no & types=$$!; failed=0; \
	$(BIN)/python -c 'from nerfcli import kernels; kernels.prepare(print)' && \
	$(BIN)/pytest -n 2 --dist loadfile || failed=1; \
	wait $$types || { echo "pyrefly found errors, see above" >&2; failed=1; }; exit $$failed

test-slow: .venv/installed-dev
	$(BIN)/pytest -n 2 --dist worksteal -m 'slow or hypothesis' --hypothesis-profile=thorough

release: .venv/installed-dev
	rm -rf dist build release-check
	$(PIP_INSTALL) build
	$(BIN)/python -m build --quiet
	$(BIN)/python -m venv release-check/env
	release-check/env/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt dist/nerfcli-*.whl
	mkdir release-check/photos && cp sample_scenes/desk/images/desk_00[0-5].jpg release-check/photos
	cd release-check && env/bin/nerfcli --version && env/bin/nerfcli run photos --budget 10s
	du -sh dist/* release-check/env

figures: .venv/installed
	$(BIN)/python benchmarks/figures.py $(DATA)

.venv/installed: $(BIN)/python pyproject.toml constraints.txt
	$(PIP_INSTALL) -e .
	@touch $@

# Torch and Triton are half of what is unpacked, which takes one core: the rest is installed at the same time. If one of the
# two fails, the last line does its work, or says why it cannot.
.venv/installed-dev: $(BIN)/python pyproject.toml constraints.txt
	@echo 'installing nerfcli and the tools of its tests, about a minute'
	@$(PIP_INSTALL) --no-deps torch triton & large=$$!; \
	$(PIP_INSTALL) --no-deps $$(grep '^[a-z].*==' constraints.txt | grep -vE '^(torch|triton)=='); wait $$large || true
	$(PIP_INSTALL) -e '.[dev]'
	@touch $@ .venv/installed

$(BIN)/python:
	@if [ -n "$(PYTHON)" ]; then set -- "$(PYTHON)"; else set -- python3.11 python3; fi; \
	found=; \
	for python; do \
	    version=$$("$$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null) || continue; \
	    found="$$found $$python is Python $$version;"; \
	    "$$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || continue; \
	    echo "making .venv with $$python (Python $$version)"; \
	    "$$python" -m venv .venv && exit 0; \
	    rm -rf .venv; exit 1; \
	done; \
	echo "Python 3.11 or newer is needed;$${found:- none found;} name one with PYTHON=/path/to/python" >&2; exit 1

clean:
	rm -rf .venv demo figure-runs build dist release-check nerfcli.egg-info .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
