"""Who is told of nothing: the watch of those who do not look."""

from workers.assets.watch import Watch, ignore


def test_whoever_does_not_look_is_told_all_the_same():
    watch: Watch = ignore
    for done in range(3):
        watch("listed", done, 2)
