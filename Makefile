# Each target sets up .venv first; that takes minutes once and no time afterwards.
#   make demo [PICTURE=...]   open a picture in the viewer (without a display: draw to demo/)
#   make test                 run the tests
#   make lint                 check the code's style
#   make setup [PYTHON=...]   only set up

.PHONY: demo test lint setup clean

demo: setup
	@scripts/demo.sh "$(PICTURE)"

test: setup
	@.venv/bin/python -m pytest -q

lint: setup
	@.venv/bin/ruff check .
	@.venv/bin/ruff format --check .

setup:
	@scripts/setup.sh

clean:
	rm -rf build dist demo .cache .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -not -path './.venv/*' -prune -exec rm -rf {} +
