"""What a file is by its first bytes, when it is no video; names and declared types are not believed."""

from __future__ import annotations

HEAD_BYTES = 512  # enough for every mark below

STILLS = {
    b"\x89PNG": "PNG",
    b"\xff\xd8\xff": "JPEG",
    b"BM": "BMP",
    b"II*\x00": "TIFF",
    b"MM\x00*": "TIFF",
    b"8BPS": "PSD",
}
_REFERRERS = (
    b"#EXTM3U",
    b"ffconcat",
    b"<?xml",
    b"<MPD",
    b"[playlist]",
    b"<smil",
    b"v=0\r\no=",
    b"v=0\no=",
    b"[Reference]",
)
_PAGES = (b"<!doctype html", b"<html", b"<head", b"<body")
_OTHERS = {
    b"PK\x03\x04": "a zip archive",
    b"\x1f\x8b": "a gzip archive",
    b"7z\xbc\xaf\x27\x1c": "a 7z archive",
    b"%PDF": "a PDF",
    b"\x7fELF": "a program",
    b"{": "JSON",
}
_BLANK = b"\xef\xbb\xbf \r\n\t"


def still_kind(head: bytes) -> str | None:
    """Name of the picture format that a file starts like, None if it is none."""
    return next((name for magic, name in STILLS.items() if head.startswith(magic)), None)


def names_other_files(head: bytes) -> bool:
    """Whether a file starts like a playlist or another list that leads elsewhere."""
    return head.lstrip(_BLANK).startswith(_REFERRERS)


def not_a_video(head: bytes) -> str | None:
    """Say what a file is if its first bytes show that it is no video.

    Args:
        head: the first `HEAD_BYTES` bytes, or all if there are fewer.

    Returns:
        What it is ("a web page"), or None if it may be a video: only opening it tells.
    """
    text = head.lstrip(_BLANK)
    if not text:
        return "empty" if not head else "blank"
    still = still_kind(head)
    if still:
        return f"a {still} picture"
    if text[:32].lower().startswith(_PAGES):
        return "a web page"
    if names_other_files(head):
        return "a list that names other files"
    for magic, name in _OTHERS.items():
        if head.startswith(magic):
            return name
    return "text" if _is_text(head) else None


def _is_text(head: bytes) -> bool:
    """All printable ASCII; containers have length fields or flags in their first bytes, and those hold zeros."""
    return all(32 <= byte < 127 or byte in b"\r\n\t" for byte in head)
