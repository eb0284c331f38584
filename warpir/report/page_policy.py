"""What a page of ours may run: content security policies name its own sources by their hashes."""

import base64
import hashlib


def source_hash(source: bytes) -> str:
    """Return a style or script as a policy's source expression, ``'sha256-...'`` (CSP 3, 2.3.1)."""
    digest = hashlib.sha256(source).digest()
    return f"'sha256-{base64.b64encode(digest).decode()}'"
