import argparse

from services.cli.arguments import Command, number, option


def test_an_option_is_what_add_argument_takes():
    parser = argparse.ArgumentParser()
    for names, settings in (option("--name", default="a"), number("--count", "how many", 3)):
        parser.add_argument(*names, **settings)
    assert vars(parser.parse_args([])) == {"name": "a", "count": 3}
    assert vars(parser.parse_args(["--name", "b", "--count", "7"])) == {"name": "b", "count": 7}


def test_a_command_starts_no_ray_unless_it_says_so():
    assert not Command("do nothing", "").starts_ray(argparse.Namespace())
