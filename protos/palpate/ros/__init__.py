"""ROS without ROS: message layouts, their bytes (CDR and ROS 1), and the keys of rmw_zenoh.

Imported only by what speaks to ROS; its bytes are coded by ``rosbags`` (docs/adr/0028-ros.md).
"""
