"""What a report's file is called after a recording of any name."""

from muvo_jax import evaluate


def test_a_recordings_name_becomes_a_part_of_a_files():
    town, copy = (evaluate._in_a_name("town", path) for path in ("town", "/data/town"))
    assert town.startswith("town-") and copy.startswith("town-") and town != copy
    drives = "+".join(f"2011_09_26_drive_{number:04d}_sync" for number in range(12))
    long = evaluate._in_a_name(drives, "/data/kitti")
    assert len(long) < 60 and long.startswith("2011_09_26_drive_0000_sync")
    assert "/" not in evaluate._in_a_name("a/b", "/data/x")
