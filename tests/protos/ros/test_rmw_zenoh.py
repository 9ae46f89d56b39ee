"""Keys, attachments and tokens as rmw_zenoh has them."""

from __future__ import annotations

import pytest
import zenoh.ext
from hypothesis import given
from hypothesis import strategies as st

from palpate.errors import ConfigError, WireError
from palpate.ros.rmw_zenoh import RosNode, RosTopic, SampleInfo, check_topic_name, gid_of

HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
CHATTER = RosTopic("/chatter", "std_msgs/msg/String", HASH)


def test_a_key_is_that_of_the_design_of_rmw_zenoh() -> None:
    assert CHATTER.key == f"0/chatter/std_msgs::msg::dds_::String_/{HASH}"
    assert RosTopic("/a/b", "x/msg/Y", domain=7).key == "7/a/b/x::msg::dds_::Y_/*"


def test_tokens_have_the_parts_that_rmw_zenoh_reads() -> None:
    node = RosNode("aac3178e", "talker", domain=2)
    assert node.token == "@ros2_lv/2/aac3178e/0/0/NN/%/%/talker"
    told = node.publisher_token(RosTopic("/a/chatter", "std_msgs/msg/String", HASH, 2))
    parts = told.split("/")
    assert parts[:9] == ["@ros2_lv", "2", "aac3178e", "0", "1", "MP", "%", "%", "talker"]
    assert parts[9:12] == ["%a%chatter", "std_msgs::msg::dds_::String_", HASH]
    # reliability : durability : history,depth : deadline : lifespan : liveliness
    assert [len(part.split(",")) for part in parts[12].split(":")] == [1, 1, 2, 2, 2, 3]
    assert len(parts) == 13
    other = node.subscription_token(CHATTER).split("/")
    assert other[4:6] == ["2", "MS"]


numbers = st.integers(-(2**63), 2**63 - 1)


@given(numbers, numbers, st.binary(min_size=16, max_size=16))
def test_an_attachment_is_what_zenohs_own_serializer_makes(
    sequence: int, time_ns: int, gid: bytes
) -> None:
    theirs = zenoh.ext.z_serialize(
        (zenoh.ext.Int64(sequence), zenoh.ext.Int64(time_ns), gid)
    ).to_bytes()
    info = SampleInfo(sequence, time_ns, gid)
    assert info.encode() == theirs
    assert SampleInfo.decode(theirs) == info


@given(st.binary(max_size=60))
def test_another_attachment_is_refused(attachment: bytes) -> None:
    reason, again = "", attachment
    try:
        again = SampleInfo.decode(attachment).encode()
    except WireError as error:
        reason = error.reason
    assert reason in ("", "attachment")
    assert again == attachment


@pytest.mark.parametrize("name", ["chatter", "/", "/a//b", "/a/", "/1a", "/a b", "/ä", "/*"])
def test_what_is_no_topic_is_refused(name: str) -> None:
    with pytest.raises(ConfigError, match="full name of a ROS topic"):
        check_topic_name(name)


def test_ids_differ_between_publishers() -> None:
    assert gid_of("a") != gid_of("b")
    assert len(gid_of("a")) == 16
    assert len(gid_of("a", 24)) == 24
