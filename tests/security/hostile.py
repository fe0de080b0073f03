"""Files that try to make a reader open other files or addresses, each in the format's real layout."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

from tests.ingest.clips import encode, moving


@dataclass(frozen=True)
class Hostile:
    """A file and how an unguarded FFmpeg would have to be opened for it to work.

    Attributes:
        name: of the file to write.
        content: its bytes.
        unguarded: options for `av.open` under which FFmpeg does follow it; None if this FFmpeg never does.
        kind: demuxer to force, for those that are not found by content.
    """

    name: str
    content: bytes
    unguarded: dict[str, str] | None = None
    kind: str | None = None


_OPEN = {"protocol_whitelist": "file,http,tcp,crypto,concat,subfile,data,cache,async,udp,rtp"}


def hls(url: str, *, key: str | None = None, segment_map: str | None = None) -> bytes:
    """A playlist of one segment, optionally with a key and an initialisation segment elsewhere (RFC 8216)."""
    lines = ["#EXTM3U", "#EXT-X-VERSION:7", "#EXT-X-TARGETDURATION:1"]
    lines += [f'#EXT-X-KEY:METHOD=AES-128,URI="{key}"'] if key else []
    lines += [f'#EXT-X-MAP:URI="{segment_map}"'] if segment_map else []
    return "\n".join([*lines, "#EXTINF:1,", url, "#EXT-X-ENDLIST", ""]).encode()


def that_ask(url: str) -> list[Hostile]:
    """Hostile files that lead to an http address."""
    loose = {**_OPEN, "allowed_extensions": "ALL", "extension_picky": "0"}
    master = f"#EXTM3U\n#EXT-X-STREAM-INF:BANDWIDTH=1\n{url}\n"
    dash = (
        '<?xml version="1.0"?><MPD xmlns="urn:mpeg:dash:schema:mpd:2011" type="static">'
        f"<Period><AdaptationSet mimeType='video/mp4'><Representation id='1' bandwidth='1'><BaseURL>{url}</BaseURL>"
        "<SegmentList><SegmentURL media=''/></SegmentList></Representation></AdaptationSet></Period></MPD>"
    )
    return [
        Hostile("list.m3u8", hls(url), loose, "hls"),
        Hostile("renamed.mp4", hls(url), loose, "hls"),
        Hostile("key.m3u8", hls(url, key=url), loose, "hls"),
        Hostile("map.m3u8", hls(url, segment_map=url), loose, "hls"),
        Hostile("master.m3u8", master.encode(), loose, "hls"),
        Hostile("after-blank.mp4", b"\n\n" + hls(url), None),
        Hostile("subfile.m3u8", hls(f"subfile,,start,0,end,9,,:{url}"), None),
        Hostile("concat-protocol.m3u8", hls(f"concat:{url}|{url}"), None),
        Hostile("script.ffconcat", f"ffconcat version 1.0\nfile '{url}'\n".encode(), {**_OPEN, "safe": "0"}, "concat"),
        Hostile("script.mp4", f"ffconcat version 1.0\nfile '{url}'\n".encode(), {**_OPEN, "safe": "0"}, "concat"),
        Hostile("stream.mpd", dash.encode(), None),
        Hostile("stream.asx", f"[Reference]\nRef1={url}\n".encode(), None),
        Hostile("play.pls", f"[playlist]\nFile1={url}\nNumberOfEntries=1\n".encode(), None),
        Hostile("stream.smil", f"<smil><body><video src='{url}'/></body></smil>".encode(), None),
        Hostile("subtitles.avi", _avi_with_subtitles(hls(url)), None),
    ]


def that_read(folder: Path) -> list[Hostile]:
    """Hostile files that lead to `private.mp4` (or `private.sub`, `frame1.png`) beside them."""
    target = folder / "private.mp4"
    encode(target, moving(3), container="mov")
    (folder / "private.sub").write_bytes(target.read_bytes())
    loose = {**_OPEN, "allowed_extensions": "ALL", "extension_picky": "0"}
    return [
        Hostile("list.m3u8", hls(target.as_uri()), loose, "hls"),
        Hostile("relative.mp4", hls("private.mp4"), loose, "hls"),
        Hostile("script.mp4", b"ffconcat version 1.0\nfile 'private.mp4'\n", {"safe": "1"}, "concat"),
        Hostile("reference.mov", _mov_with_data_elsewhere(folder), {"enable_drefs": "1"}),
        Hostile("stream.sdp", b"v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=x\r\nm=video 5004 RTP/AVP 96\r\n", None),
        Hostile("private.idx", b"# VobSub index file, v7 (do not modify)\nsize: 720x480\nid: en, index: 0\n", None),
        Hostile("graph.mp4", f"movie={target}".encode(), None),
        Hostile("frame%d.png", b"", None),
    ]


def _box(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I4s", 8 + len(body), kind) + body


def _mov_with_data_elsewhere(folder: Path) -> bytes:
    """A movie whose samples lie in `private.mp4`, by a Macintosh alias (QuickTime file format, data reference atom)."""
    plain = (folder / "private.mp4").read_bytes()
    name = b"private.mp4"
    path = str(folder / "private.mp4").encode()
    alias = bytes(4 + 10) + bytes([1]) + b"x".ljust(27, b"\0") + bytes(12)
    alias += bytes([len(name)]) + name.ljust(63, b"\0") + bytes(16)
    alias += struct.pack(">HH", 1, 1) + bytes(16)
    alias += struct.pack(">HH", 2, len(path)) + path + bytes(len(path) % 2) + struct.pack(">HH", 0xFFFF, 0)
    dref = _box(b"dref", struct.pack(">II", 0, 1) + _box(b"alis", alias.ljust(220, b"\0")))
    moved = _replaced(plain, [b"moov", b"trak", b"mdia", b"minf", b"dinf", b"dref"], dref)
    start = moved.index(b"mdat")
    size = struct.unpack_from(">I", moved, start - 4)[0]
    return moved[: start + 4] + bytes(size - 8) + moved[start - 4 + size :]  # its own samples are blank


def _replaced(data: bytes, path: list[bytes], box: bytes) -> bytes:
    """`data` with the first box at `path` replaced and the sizes around it set right."""
    out, place = b"", 0
    while place < len(data):
        size, kind = struct.unpack_from(">I4s", data, place)
        body = data[place + 8 : place + size]
        if kind == path[0]:
            out += box if len(path) == 1 else _box(kind, _replaced(body, path[1:], box))
            path = [b"none"]
        else:
            out += data[place : place + size]
        place += size
    return out


def _avi_with_subtitles(script: bytes) -> bytes:
    """An AVI whose subtitle stream embeds a file of its own (GAB2), the way the attacks of 2017 did it."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return kind + struct.pack("<I", len(body)) + body + bytes(len(body) % 2)

    def listed(kind: bytes, body: bytes) -> bytes:
        return chunk(b"LIST", kind + body)

    picture = bytes(16 * 16 * 3)
    gab2 = b"GAB2\0" + struct.pack("<HIHI", 2, 0, 4, len(script)) + script
    video_head = struct.pack(
        "<4s4sIHHIIIIIIIIHHHH", b"vids", b"\0\0\0\0", 0, 0, 0, 0, 1, 25, 0, 1, 768, 0, 0, 0, 0, 16, 16
    )
    video = struct.pack("<IiiHHIIiiII", 40, 16, 16, 1, 24, 0, len(picture), 0, 0, 0, 0)
    text_head = struct.pack(
        "<4s4sIHHIIIIIIIIHHHH", b"txts", b"\0\0\0\0", 0, 0, 0, 0, 1, 25, 0, 1, 999, 0, 0, 0, 0, 0, 0
    )
    main = struct.pack("<14I", 40000, 0, 0, 0x10, 1, 0, 2, 0, 16, 16, 0, 0, 0, 0)
    heads = chunk(b"avih", main)
    heads += listed(b"strl", chunk(b"strh", video_head) + chunk(b"strf", video))
    heads += listed(b"strl", chunk(b"strh", text_head) + chunk(b"strf", b""))
    movie = chunk(b"01tx", gab2) + chunk(b"00db", picture)
    body = listed(b"hdrl", heads) + listed(b"movi", movie)
    return b"RIFF" + struct.pack("<I", 4 + len(body)) + b"AVI " + body
