"""`python -m link certs DIR`: makes certificates for --secure."""

if __name__ == "__main__":  # here, because the modules below take long to load
    from link.early import end_at_once

    end_at_once()

import sys

from link import certs, cli


def main(prog: str = "python -m link", arguments: list[str] | None = None) -> int:
    """Parse the command line and make certificates."""
    parser = cli.Parser(prog=prog)
    commands = parser.add_subparsers(
        dest="command", required=True, parser_class=cli.Parser, metavar="COMMAND"
    )
    certs.add_arguments(commands.add_parser("certs", help="make certificates for --secure"))
    return certs.run(parser.parse_args(sys.argv[1:] if arguments is None else arguments))


if __name__ == "__main__":
    cli.run(main)
