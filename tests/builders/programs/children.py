"""Code that must run in a Python process of its own."""

import subprocess
import sys


def output_of(code: str) -> str:
    """Run code in a new process; return what it prints."""
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return child.stdout
