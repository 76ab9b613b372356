"""Protects the vehicle from other web pages, and from people who may only look."""

import pytest

from ground.view.access import AccessRules, origin

LOCAL = AccessRules("127.0.0.1", 8447)
EVERYWHERE = AccessRules("0.0.0.0", 8447)
PROXIED = LOCAL._replace(origins=("https://drone.example", "http://other.example:8080"))


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
        (LOCAL, "drone.example", False),
        (PROXIED, "drone.example", True),
        (PROXIED, "Drone.Example", True),
        (PROXIED, "other.example:8080", True),
        (PROXIED, "drone.example:8447", False),
        (PROXIED, "other.example", False),
        (PROXIED, "evil.drone.example", False),
        (PROXIED, "", False),
        (PROXIED, "127.0.0.1:8447", True),
    ],
)
def test_only_the_servers_own_name_or_a_proxys_is_allowed_as_host(
    rules: AccessRules, host: str, allowed: bool
) -> None:
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
    ("origin", "host", "allowed"),
    [
        ("https://drone.example", "drone.example", True),
        ("https://drone.example", "127.0.0.1:8447", True),  # a proxy that names the server by its own address
        ("http://other.example:8080", "other.example:8080", True),
        ("http://127.0.0.1:8447", "127.0.0.1:8447", True),
        ("http://drone.example", "drone.example", False),  # not encrypted: not the origin that was named
        ("http://other.example", "other.example:8080", False),
        ("https://evil.example", "drone.example", False),
        ("file://", "drone.example", False),
        (None, "drone.example", False),
    ],
)
def test_other_origins_are_allowed_as_they_were_named(origin: str | None, host: str, allowed: bool) -> None:
    assert PROXIED.allows_origin(origin, host) == allowed


@pytest.mark.parametrize(
    ("text", "written"),
    [
        ("https://drone.example", "https://drone.example"),
        ("HTTPS://Drone.Example/", "https://drone.example"),
        ("https://drone.example:443", "https://drone.example"),
        ("http://drone.example:80/", "http://drone.example"),
        ("http://drone.example:443", "http://drone.example:443"),
        ("http://[fe80::1]:8080", "http://[fe80::1]:8080"),
    ],
)
def test_an_origin_is_kept_as_browsers_write_it(text: str, written: str) -> None:
    assert origin(text) == written


@pytest.mark.parametrize(
    "text",
    [
        "",
        "*",
        "null",
        "drone.example",
        "https://",
        "https://a/b",
        "https://a?b",
        "https://a#b",
        "https://me@a",
        "https://a b",
    ],
)
def test_what_is_no_origin_is_refused_with_what_is_wanted(text: str) -> None:
    with pytest.raises(
        ValueError,
        match=r"is not an origin; wanted the beginning of an address, without a path: https://drone\.example",
    ):
        origin(text)


@pytest.mark.parametrize(
    ("rules", "address"),
    [
        (LOCAL, "http://127.0.0.1:8447/"),
        (AccessRules("::1", 80), "http://[::1]:80/"),
        (AccessRules("drone.lan", 8447, "secret"), "http://drone.lan:8447/"),
    ],
)
def test_the_address_that_is_printed_opens_the_page_and_holds_no_word(
    rules: AccessRules, address: str
) -> None:
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
        (PROXIED, "", False),  # whoever comes from the proxy comes from this machine
        (PROXIED, "anything", False),
        (PROXIED._replace(token="secret"), "secret", True),
    ],
)
def test_elsewhere_only_the_right_word_commands(rules: AccessRules, token: str, may: bool) -> None:
    why_not = rules.why_no_commands(token)
    assert (why_not == "") == may
    assert "secret" not in why_not
