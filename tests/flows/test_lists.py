"""Lists of videos: every line is either a video or a problem with its number and reason."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from flows.lists import ListEntry, VideoList, VideoOptions, read_list
from flows.request import VideoRequest
from tasks.errors import ListError
from tasks.sources import SourcePolicy

POLICY = SourcePolicy()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("a.mp4", "b.mp4", "with space.mp4", "sub/c.mp4"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"x")
    return tmp_path


def written(folder: Path, text: str | bytes, name: str = "list.txt") -> VideoList:
    path = folder / name
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return read_list(path, POLICY)


def lines(videos: VideoList) -> list[tuple[int, str]]:
    return [(entry.line, entry.source) for entry in videos.entries]


def test_text_lists_are_read_as_yt_dlp_reads_them(folder: Path) -> None:
    videos = written(
        folder,
        "\ufeff# a comment\n\n; another\n] and another\na.mp4\r\n  sub/c.mp4  # said of it\nwith space.mp4\n"
        "https://example.org/clip.mp4#t=3\nyoutu.be/dQw4w9WgXcQ?si=abc\ns3://bucket/key.mp4\n",
    )
    assert videos.problems == ()
    assert lines(videos) == [
        (5, str(folder / "a.mp4")),
        (6, str(folder / "sub/c.mp4")),
        (7, str(folder / "with space.mp4")),
        (8, "https://example.org/clip.mp4"),
        (9, "https://www.youtube.com/watch?v=dQw4w9WgXcQ"),
        (10, "s3://bucket/key.mp4"),
    ]


def test_standard_input_is_read_for_a_dash(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    videos = read_list("-", POLICY, stdin=iter([b"a.mp4\n", b"# x\n", b"nothing.mp4\n"]))
    assert lines(videos) == [(1, str(folder / "a.mp4"))]
    assert [problem.line for problem in videos.problems] == [3]


def test_duplicates_are_dropped_and_reported_with_the_line_of_the_first(folder: Path) -> None:
    videos = written(
        folder,
        "a.mp4\n./a.mp4\nhttps://www.youtube.com/watch?v=dQw4w9WgXcQ&list=PL1\nhttps://youtu.be/dQw4w9WgXcQ\n"
        "https://EXAMPLE.org:443/x.mp4\nhttps://example.org/x.mp4\n",
    )
    assert [entry.line for entry in videos.entries] == [1, 3, 5]
    assert [(p.line, "line " + str(p.line - 1) in p.reason) for p in videos.problems] == [
        (2, True),
        (4, True),
        (6, True),
    ]


def test_one_video_may_stand_twice_with_other_options(folder: Path) -> None:
    videos = written(folder, "source,start_s,end_s\na.mp4,0,5\na.mp4,5,10\na.mp4,0.0,5.0\n", "list.csv")
    assert [entry.line for entry in videos.entries] == [2, 3]
    assert [problem.line for problem in videos.problems] == [4]


def test_csv_rows_carry_options_and_bad_cells_are_named(folder: Path) -> None:
    videos = written(
        folder,
        "url, Subject,start_s,end_s,preset\n# off for now\na.mp4,1,0.5,2.5,draft\nb.mp4,,,,\nsub/c.mp4,-1,,,\n"
        'sub/c.mp4,,5,4,\nsub/c.mp4,,,,best\n"with space.mp4",,,7,\n,,,,\nb.mp4,,,,,extra\n',
        "list.csv",
    )
    assert [(e.line, e.options) for e in videos.entries] == [
        (3, VideoOptions(subject=1, start_s=0.5, end_s=2.5, preset="draft")),
        (4, VideoOptions()),
        (8, VideoOptions(end_s=7)),
    ]
    reasons = {problem.line: problem.reason for problem in videos.problems}
    assert set(reasons) == {5, 6, 7, 9, 10}
    assert "subject" in reasons[5] and "end_s after start_s" in reasons[6] and "preset" in reasons[7]
    assert "6" in reasons[10]


def test_csv_lines_are_counted_in_the_file_not_in_rows(folder: Path) -> None:
    videos = written(folder, 'source,preset\n"a\n.mp4",draft\nb.mp4,draft\n', "list.csv")
    assert [problem.line for problem in videos.problems] == [2]
    assert [entry.line for entry in videos.entries] == [4]


def test_csv_whose_quotes_do_not_close_stops_there_and_says_so(folder: Path) -> None:
    videos = written(folder, 'source\na.mp4\n"b.mp4\nsub/c.mp4\n', "list.csv")
    assert [entry.line for entry in videos.entries] == [2]
    assert [problem.line for problem in videos.problems] == [3] and "nothing after it" in videos.problems[0].reason


def test_parquet_rows_carry_options(folder: Path) -> None:
    table = pa.table({"video": ["a.mp4", "b.mp4", None], "subject": [None, 2, 0], "start_s": [1.25, None, None]})
    pq.write_table(table, folder / "list.parquet")
    videos = read_list(folder / "list.parquet", POLICY)
    assert [(e.line, e.options) for e in videos.entries] == [
        (1, VideoOptions(start_s=1.25)),
        (2, VideoOptions(subject=2)),
    ]
    assert [problem.line for problem in videos.problems] == [3]


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("list.csv", b"source,sart_s\na.mp4,1\n", "sart_s"),
        ("list.csv", b"subject\n1\n", "source"),
        ("list.csv", b"source,url\na.mp4,b.mp4\n", "one column"),
        ("list.csv", "source\nä.mp4\n".encode("latin-1"), "UTF-8"),
        ("list.parquet", b"not parquet", "Parquet"),
        ("list.txt", "a.mp4\n".encode("utf-16"), "UTF-16"),
        ("list.txt", bytes(4096), "ahoy run"),
    ],
)
def test_a_list_that_is_none_is_refused_as_a_whole(folder: Path, name: str, content: bytes, words: str) -> None:
    (folder / name).write_bytes(content)
    with pytest.raises(ListError, match=words):
        read_list(folder / name, POLICY)


def test_a_list_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(ListError, match=r"nothing\.txt"):
        read_list(tmp_path / "nothing.txt", POLICY)


def test_what_the_download_archive_names_is_left_out(folder: Path) -> None:
    (folder / "archive").write_text("youtube dQw4w9WgXcQ\ngeneric clip\n")
    (folder / "list.txt").write_text("https://youtu.be/dQw4w9WgXcQ\nhttps://youtu.be/AAAAAAAAAAA\n")
    videos = read_list(folder / "list.txt", SourcePolicy(archive=folder / "archive"))
    assert [entry.line for entry in videos.entries] == [2]
    assert "archive" in videos.problems[0].reason


@given(st.lists(st.text(st.characters(exclude_characters="\n"), max_size=60), max_size=20))
@example(["\0"])
def test_no_text_breaks_the_reader_and_every_line_is_accounted_for(content: list[str]) -> None:
    data = "\n".join(content).encode("utf-8", "surrogatepass")
    head = data[:4096]
    if head.count(0) > len(head) // 10:
        with pytest.raises(ListError, match="got binary data"):
            read_list("-", POLICY, stdin=[data])
        return
    videos = read_list("-", POLICY, stdin=[data])
    seen = [entry.line for entry in videos.entries] + [problem.line for problem in videos.problems]
    assert len(seen) == len(set(seen))
    for number, raw in enumerate(data.removeprefix(b"\xef\xbb\xbf").split(b"\n"), start=1):
        text = raw.decode("utf-8", "replace").strip(" \t\r")
        assert (number in seen) == bool(text and not text.startswith(("#", ";", "]")))
    for problem in videos.problems:
        assert problem.text.isprintable() and problem.reason


def test_a_name_that_no_file_system_takes_is_a_problem_not_a_crash(folder: Path) -> None:
    videos = written(folder, "x" * 1500 + "\na.mp4\n")
    assert [problem.line for problem in videos.problems] == [1] and [entry.line for entry in videos.entries] == [2]


def test_an_entry_makes_a_request_that_honours_its_options(folder: Path) -> None:
    options = VideoOptions(subject=1, start_s=0.1, end_s=2.7, preset="draft")
    entry = ListEntry(line=1, source=str(folder / "a.mp4"), name="a", options=options)
    settings = VideoRequest(out="out", **entry.request_fields()).settings()
    assert (settings.ingest.start_s, settings.ingest.end_s, settings.perceive.subject) == (0.1, 2.7, 1)
    assert settings.ingest.max_frames == 48  # the draft preset's
    assert VideoRequest(out="out", video="a.mp4").settings().ingest.end_s is None
