"""C programs around exported headers."""

import shutil
import subprocess

import numpy as np

COMPILERS = [name for name in ("gcc", "clang") if shutil.which(name)]
STRICT = ("-Wall", "-Wextra", "-Wpedantic", "-Werror", "-ffp-contract=off")
RESET = 20
"""Step before which a law is reset with its integral, in programs of C and the runs that they are compared with."""
TABLE = """#include <stdio.h>
#include "arm.h"
int main(void) {{
  {t} state[2 * {n}], found[{n} * {n} + 2 * {n}];
  while (fread(state, sizeof state, 1, stdin) == 1) {{
    arm_mass_matrix(state, found);
    arm_bias(state, state + {n}, found + {n} * {n});
    arm_gravity(state, found + {n} * {n} + {n});
    fwrite(found, sizeof found, 1, stdout);
  }}
  return 0;
}}
"""
"""Mass matrix, bias and gravity of ``n`` joints of type ``t`` at states from stdin."""


def compiled(folder, text, *flags, compiler=COMPILERS[0] if COMPILERS else ""):
    source, binary = folder / "law.c", folder / "law"
    source.write_text(text)
    subprocess.run([compiler, *STRICT, *flags, str(source), "-o", str(binary), "-lm"], check=True)
    return binary


def law_program(header, inputs, prefix, kind, joints):
    """Return a program that reads steps from stdin and writes their efforts to stdout; step RESET is
    after a reset.
    """
    arrays = "".join(f"  {kind} {name}[{size}];\n" for name, size in inputs)
    reads = "".join(
        f"    if (fread({n}, sizeof({kind}), {size}, stdin) != {size}) return 0;\n"
        for n, size in inputs
    )
    arguments = ", ".join(name for name, _ in inputs)
    return f"""#include <stdio.h>
#include <string.h>
{header}
int main(void) {{
  {prefix}_state state;
  {kind} effort[{joints}];
{arrays}  memset(&state, 0, sizeof state);
  for (int at = 0;; ++at) {{
{reads}    if (at == 0) {prefix}_init(&state, measurement);
    if (at == {RESET}) {prefix}_reset(&state, measurement);
    {prefix}_step(&state, {arguments}, effort);
    fwrite(effort, sizeof({kind}), {joints}, stdout);
  }}
}}
"""


def efforts_in_c(folder, params, header, columns, *flags, prefix="batchpid", compiler=None):
    """Return the efforts (steps, joints) that an exported header computes from ``columns`` (steps,
    ...).
    """
    kind = "float" if params.dtype == np.float32 else "double"
    sizes = [(name, column[0].size) for name, column in columns.items()]
    text = law_program(header, sizes, prefix, kind, params.num_joints)
    chosen = {} if compiler is None else {"compiler": compiler}
    binary = compiled(folder, text, *(flags or ("-std=c99", "-O2")), **chosen)
    rows = np.concatenate([column.reshape(len(column), -1) for column in columns.values()], axis=1)
    ran = subprocess.run(
        [binary], input=rows.astype(params.dtype).tobytes(), capture_output=True, check=True
    )
    return np.frombuffer(ran.stdout, params.dtype).reshape(-1, params.num_joints)
