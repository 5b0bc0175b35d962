"""The names that everybody writes against."""

import itertools
import subprocess
import sys

import gsasr

CODE = """
import types, gsasr
for name in {names}:
    value = getattr(gsasr, name)
    assert not isinstance(value, types.ModuleType), name
for name in {names}:  # also after all modules were loaded
    assert not isinstance(getattr(gsasr, name), types.ModuleType), name
"""


def test_every_name_is_what_it_says_in_whatever_order_they_are_used():
    orders = itertools.islice(itertools.permutations(["render", "predict", "load_model"]), 3)
    for order in (*orders, tuple(gsasr.__all__), tuple(reversed(gsasr.__all__))):
        code = CODE.format(names=list(order))
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
        assert done.returncode == 0, (order, done.stderr)
