"""`python -m sitl`: fly or replay a mission, look into its log, or run one part alone."""

if __name__ == "__main__":  # here, because the modules below take long to load
    from link.early import begin

    begin()

import sys

from link import cli
from link.cli import Command

# The commands that need no estimator or agent. Those of other houses are known by their names only.
COMMANDS = {
    "fly": Command("sitl.launch.command", "fly one mission, each part a process of its own"),
    "view": Command("ground.view.command", "show missions on a page, live or recorded"),
    "status": Command("ground.desk.status", "show how the parts of a running mission are doing"),
    "leave-out": Command("ground.desk.leave_out", "let a vehicle leave a search of several"),
    "log": Command("ground.desk.summary", "summarise a log, or print one of its keys as CSV"),
    "draw": Command("ground.desk.draw", "draw a log as a picture or an animation"),
    "findings": Command("ground.findings.command", "write what a flight has found: page, map, figures"),
    "worlds": Command("ground.desk.worlds", "show what is in a recorded plume"),
    "replay": Command("ground.replay.command", "feed a log to the estimator and agent again"),
    "record": Command("ground.desk.recorder", "record everything on a bus until interrupted"),
    "router": Command("sitl.launch.router", "the Zenoh router"),
    "uav": Command("sitl.uav.command", "the simulated vehicle"),
    "payload": Command("sitl.uav.payload", "the gas sensor of a real autopilot"),
    "ros2": Command("ground.ros2.command", "ROS 2 topics by rmw_zenoh's rules, without ROS"),
    "bridge": Command("aircraft.bridge.command", "ground stations and autopilots over UDP, TCP, serial"),
}
SCRIPTS = (".yaml", ".yml")


def main(prog: str = "python -m sitl", arguments: list[str] | None = None) -> int:
    """Run a command; without one, `fly`."""
    words = sys.argv[1:] if arguments is None else arguments
    first = words[0] if words else ""
    if not first or first.endswith(SCRIPTS) or (first.startswith("-") and first not in ("-h", "--help")):
        words = ["fly", *words]
    if words[0] not in COMMANDS:
        parser = cli.Parser(
            prog=prog,
            description="Simulated flights to a gas leak. Without a command: fly, with its defaults.",
        )
        cli.front(parser, {name: command.does for name, command in COMMANDS.items()}).parse_args(words[:1])
    return cli.start(f"{prog} {words[0]}", COMMANDS[words[0]], words[1:])


if __name__ == "__main__":
    cli.run(main)
