"""C programs around exported headers."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

COMPILERS = [name for name in ("gcc", "clang") if shutil.which(name)]
STRICT = ("-Wall", "-Wextra", "-Wpedantic", "-Werror", "-ffp-contract=off")
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


def compiled(folder: Path, text: str, *flags: str, compiler: str = COMPILERS[0] if COMPILERS else "") -> Path:
    source, binary = folder / "law.c", folder / "law"
    source.write_text(text)
    subprocess.run([compiler, *STRICT, *flags, str(source), "-o", str(binary), "-lm"], check=True)
    return binary
