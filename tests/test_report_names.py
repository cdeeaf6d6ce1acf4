"""What a report's file is called after a recording of any name."""

from muvo_jax import evaluate


def test_a_recordings_name_becomes_a_part_of_a_files():
    assert evaluate._in_a_name("town") == "town"
    drives = "+".join(f"2011_09_26_drive_{number:04d}_sync" for number in range(12))
    long, other = evaluate._in_a_name(drives), evaluate._in_a_name(drives + "+more")
    assert len(long) < 60 and long != other and long.startswith("2011_09_26_drive_0000_sync")
    assert "/" not in evaluate._in_a_name("a/b") and evaluate._in_a_name("a/b") != evaluate._in_a_name("a-b")
