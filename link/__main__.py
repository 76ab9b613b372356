"""`python -m link certs DIR`: makes certificates for --secure."""

if __name__ == "__main__":  # here, because the modules below take long to load
    from link.early import begin

    begin()

from link import certs, cli


def main(arguments: list[str] | None = None) -> int:
    """Parse the command line and make certificates."""
    parser = cli.Parser(prog="python -m link")
    commands = parser.add_subparsers(
        dest="command", required=True, parser_class=cli.Parser, metavar="COMMAND"
    )
    certs.add_arguments(commands.add_parser("certs", help="make certificates for --secure"))
    return certs.run(parser.parse_args(arguments))


if __name__ == "__main__":
    cli.run(main)
