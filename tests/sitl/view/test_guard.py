"""Protects the vehicle from other web pages, and from people who may only look."""

import pytest

from sitl.view.guard import AccessRules

LOCAL = AccessRules("127.0.0.1", 8447)
EVERYWHERE = AccessRules("0.0.0.0", 8447)


@pytest.mark.parametrize(
    ("rules", "host", "allowed"),
    [
        (LOCAL, "127.0.0.1:8447", True),
        (LOCAL, "localhost:8447", True),
        (LOCAL, "LOCALHOST:8447", True),
        (LOCAL, "127.0.0.1:8448", False),
        (LOCAL, "127.0.0.1", False),  # port 80
        (LOCAL, "evil.example:8447", False),
        (LOCAL, "127.0.0.1.evil.example:8447", False),
        (LOCAL, "192.168.1.5:8447", False),
        (LOCAL, "127.0.0.1:8447@evil.example", False),
        (LOCAL, "", False),
        (LOCAL, "127.0.0.1:²", False),
        (LOCAL, "127.0.0.1:" + "9" * 5000, False),  # Python reads no number of so many digits
        (AccessRules("127.0.0.1", 80), "127.0.0.1", True),
        (AccessRules("::1", 8447), "[::1]:8447", True),
        (AccessRules("::1", 80), "[::1]", True),
        (AccessRules("192.168.1.5", 8447), "192.168.1.5:8447", True),
        (AccessRules("192.168.1.5", 8447), "localhost:8447", False),
        (AccessRules("drone.lan", 8447), "drone.lan:8447", True),
        (AccessRules("drone.lan", 8447), "evil.example:8447", False),
        (EVERYWHERE, "192.168.1.5:8447", True),
        (EVERYWHERE, "localhost:8447", True),
        (EVERYWHERE, "evil.example:8447", False),
    ],
)
def test_only_the_servers_own_name_is_allowed_as_host(rules: AccessRules, host: str, allowed: bool) -> None:
    assert rules.allows_host(host) == allowed


@pytest.mark.parametrize(
    ("origin", "allowed"),
    [
        ("http://127.0.0.1:8447", True),
        ("http://localhost:8447", False),  # another origin than the page that was asked for
        ("https://127.0.0.1:8447", False),
        ("http://127.0.0.1:8448", False),
        ("http://evil.example", False),
        ("null", False),
        ("", False),
    ],
)
def test_only_the_page_itself_is_allowed_as_origin(origin: str, allowed: bool) -> None:
    assert LOCAL.allows_origin(origin, "127.0.0.1:8447") == allowed


@pytest.mark.parametrize(
    ("rules", "address"),
    [
        (LOCAL, "http://127.0.0.1:8447/"),
        (AccessRules("::1", 80), "http://[::1]:80/"),
        (AccessRules("drone.lan", 8447, "two words&more=é/#"), "http://drone.lan:8447/?token=two%20words%26more%3D%C3%A9%2F%23"),
    ],
)
def test_the_address_that_is_printed_opens_the_page_with_its_token(rules: AccessRules, address: str) -> None:
    assert rules.address == address


@pytest.mark.parametrize(
    ("rules", "token", "may"),
    [
        (LOCAL, "", True),
        (LOCAL, "anything", True),
        (AccessRules("::1", 1), "", True),
        (AccessRules("localhost", 1), "", True),
        (EVERYWHERE, "", False),
        (AccessRules("192.168.1.5", 1), "", False),
        (AccessRules("drone.lan", 1), "", False),
        (EVERYWHERE._replace(token="secret"), "secret", True),
        (EVERYWHERE._replace(token="secret"), "", False),
        (EVERYWHERE._replace(token="secret"), "secre", False),
        (EVERYWHERE._replace(token="secret"), "sécret", False),
        (LOCAL._replace(token="secret"), "", False),  # who sets a token wants it everywhere
        (LOCAL._replace(token="secret"), "secret", True),
    ],
)
def test_elsewhere_only_the_right_token_commands(rules: AccessRules, token: str, may: bool) -> None:
    why_not = rules.why_no_commands(token)
    assert (why_not == "") == may
    assert "secret" not in why_not
