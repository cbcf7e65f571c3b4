"""Zip archives (NPZ, torch.save) that are damaged in ways for which Python's readers have errors of their own."""

import io
import zipfile
from pathlib import Path

# Of a member: where its own header and the archive's directory say its flags, then its compression.
PLACES = {b"PK\3\4": 6, b"PK\1\2": 8}
ENCRYPTED, UNKNOWN = b"\1\0", (99).to_bytes(2, "little")


def rewritten(path: Path, compression: int, change=lambda name, content: content) -> bytearray:
    """The archive's bytes with its members written again."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", compression) as archive:
        for name, content in members.items():
            archive.writestr(name, change(name, content))
    return bytearray(file.getvalue())


def marked(content: bytearray, mark: bytes, after: int) -> bytearray:
    """The archive with a mark on all members."""
    for signature, place in PLACES.items():
        at = content.find(signature)
        while at >= 0:
            content[at + place + after : at + place + after + 2] = mark
            at = content.find(signature, at + 4)
    return content


def encrypted(path: Path) -> bytearray:
    return marked(rewritten(path, zipfile.ZIP_STORED), ENCRYPTED, after=0)


def unknown_compression(path: Path) -> bytearray:
    return marked(rewritten(path, zipfile.ZIP_STORED), UNKNOWN, after=2)


def broken_stream(path: Path) -> bytearray:
    """Compressed, with the first bytes of each member's stream wrong."""
    content = rewritten(path, zipfile.ZIP_DEFLATED)
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        for member in archive.infolist():
            start = member.header_offset + 30 + len(member.filename)
            content[start : start + 16] = b"\xff" * 16
    return content


def open_bracket(path: Path) -> bytearray:
    """An array's header with a bracket too many."""
    return rewritten(path, zipfile.ZIP_STORED, lambda name, content: content.replace(b"'shape': (", b"'shape':((", 1))


def empty_kind(path: Path) -> bytearray:
    """An array's header whose kind of numbers is an empty tuple."""
    return rewritten(
        path, zipfile.ZIP_STORED, lambda name, content: content.replace(b"'descr': '<f8'", b"'descr': ()    ")
    )


ARCHIVES = (encrypted, unknown_compression, broken_stream)
ARRAYS = (open_bracket, empty_kind)
