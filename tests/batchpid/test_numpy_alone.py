"""The controller needs NumPy and the standard library, nothing else."""

import re
import subprocess
import sys
from pathlib import Path

LAW = Path(__file__).parents[2] / "docs" / "law.md"
REFUSE = """
import sys

class Refuse:
    def find_spec(self, name, path=None, target=None):
        package = name.partition(".")[0]
        if package not in {"numpy", "batchpid", *sys.stdlib_module_names}:
            raise ImportError(f"{name} is neither NumPy nor of the standard library")

sys.meta_path.insert(0, Refuse())
"""


def run(program):
    done = subprocess.run([sys.executable, "-c", REFUSE + program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_first_examples_of_the_law_need_numpy_alone():
    programs = re.findall(r"```python\n(.*?)```", LAW.read_text(), re.S)
    last = next(at for at, code in enumerate(programs) if "bp.BatchPID" in code)
    assert last < 3
    run("".join(programs[: last + 1]))


def test_every_module_but_the_backends_of_jax_can_be_imported_with_numpy_alone():
    run(
        "import importlib, pkgutil, batchpid\n"
        "def load(package):\n"
        "    for module in pkgutil.iter_modules(package.__path__):\n"
        "        if module.name not in ('__main__', 'blocks', 'sim', 'assets', '_program'):\n"
        "            loaded = importlib.import_module(f'{package.__name__}.{module.name}')\n"
        "            load(loaded) if module.ispkg else None\n"
        "load(batchpid)\n"
    )


def test_params_go_to_json_and_back_with_numpy_alone():
    run(
        "import batchpid as bp\n"
        "text = bp.dumps_params(bp.make_params(2, 1.0), ['a', 'b'])\n"
        "assert bp.loads_params(text)[1] == ['a', 'b']\n"
    )
