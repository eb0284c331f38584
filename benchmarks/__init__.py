"""Questions about speed and error, one module each: ``python -m benchmarks.<question>``."""
