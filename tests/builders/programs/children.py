"""Code that must run in a Python process of its own."""

import os
import subprocess
import sys


def output_of(code: str, *arguments: str, python: str = sys.executable, **env: str) -> str:
    """Run code in a new process, which must end well; return what it prints."""
    command = [python, "-c", code, *arguments]
    child = subprocess.run(command, env={**os.environ, **env}, capture_output=True, text=True)
    assert child.returncode == 0, child.stdout + child.stderr
    return child.stdout
