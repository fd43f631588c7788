"""`python -m experiments` tells which experiments there are, with a line each."""

import ast
from collections.abc import Iterator
from pathlib import Path


def experiments() -> Iterator[tuple[str, str]]:
    """Each experiment's command and the first line of its page, which nothing is imported for."""
    for path in sorted(Path(__file__).parent.glob("[!_]*.py")):
        about = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
        yield f"python -m experiments.{path.stem}", about.partition("\n")[0]


if __name__ == "__main__":
    named = list(experiments())
    width = max(len(command) for command, _ in named)
    for command, about in named:
        print(f"{command:<{width}}  {about}")
    print("Each tells with --help what can be given.")
