"""Flight logs of other programs as tables: one module for each kind of file, its library imported only there."""

from collections.abc import Callable

from thermorender.trajectory.sources.dataflash import read_dataflash
from thermorender.trajectory.sources.pose_list import read_poses
from thermorender.trajectory.sources.rosbag import read_rosbag
from thermorender.trajectory.sources.srt import read_srt
from thermorender.trajectory.sources.ulog import read_ulog
from thermorender.trajectory.sources.xml_tracks import read_gpx, read_kml
from thermorender.trajectory.tables import Table, read_csv

__all__ = ["SOURCES"]

# Names of the key `reader` of a mapping, to functions of a file's path.
SOURCES: dict[str, Callable[[str], list[Table]]] = {
    "csv": read_csv,
    "dataflash": read_dataflash,
    "gpx": read_gpx,
    "kml": read_kml,
    "poses": read_poses,
    "rosbag": read_rosbag,
    "srt": read_srt,
    "ulog": read_ulog,
}
