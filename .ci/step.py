"""Run a command and show in one line what it does: python .ci/step.py TITLE COMMAND ...

On a terminal the line changes with the output of pip and of the compiler; in a file it says when
the step began and how long it took. All output is printed if the command fails.
"""

import re
import shutil
import subprocess
import sys
import time

SHOWN = re.compile(
    r"(Collecting|Downloading|Installing collected packages|Building \w+ for|building) (.*)"
)


def main() -> int:
    """Run the command and return its exit status."""
    title, *command = sys.argv[1:]
    began, output, is_terminal = time.monotonic(), [], sys.stdout.isatty()
    print(f"{title} ...", end="" if is_terminal else "\n", flush=True)
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        for line in process.stdout or ():
            output.append(line)
            if is_terminal and (found := SHOWN.search(line)):
                text = f"{title} ... {time.monotonic() - began:.0f} s: {found[1]} {found[2]}"
                print(
                    f"\r\033[K{text[: shutil.get_terminal_size().columns - 1]}", end="", flush=True
                )
    if process.returncode:
        print("\n" + "".join(output), end="", file=sys.stderr)
        return process.returncode
    warnings = [line for line in output if line.startswith("warning: ") or "failed:" in line]
    print(
        f"{chr(13) + chr(27) + '[K' if is_terminal else ''}{title}:"
        f" {time.monotonic() - began:.0f} s",
        flush=True,
    )
    print(*warnings, sep="", end="")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
