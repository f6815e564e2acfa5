"""The public client `cosysairsim` against a bridge: `python airsim_client.py PORT FILE`; prints what it got as JSON."""

import json
import sys

import cosysairsim as airsim
import numpy as np

client = airsim.VehicleClient(port=int(sys.argv[1]), timeout_value=60)
client.confirmConnection()
# Above the scene, 12 m up, looking down with north on top; then moved east without turning.
down = airsim.Pose(airsim.Vector3r(1.0, 2.0, -12.0), airsim.Quaternionr(0.0, -np.sqrt(0.5), 0.0, np.sqrt(0.5)))
client.simSetVehiclePose(down, True)
kept = airsim.Pose(airsim.Vector3r(1.0, 3.0, -12.0), airsim.Quaternionr(np.nan, np.nan, np.nan, np.nan))
client.simSetVehiclePose(kept, True)
types = airsim.ImageType
wanted = [
    (types.Infrared, True, False), (types.Infrared, False, False), (types.Infrared, False, True),
    (types.Scene, False, False), (types.DepthPlanar, True, False), (types.Segmentation, False, False),
]  # fmt: skip
responses = client.simGetImages([airsim.ImageRequest("0", *each) for each in wanted])
images = {}
for number, each in enumerate(responses):
    if each.pixels_as_float:
        images[str(number)] = airsim.get_pfm_array(each)
    elif each.compress:
        images[str(number)] = np.frombuffer(each.image_data_uint8, np.uint8)
    else:
        images[str(number)] = airsim.string_to_uint8_array(each.image_data_uint8).reshape(each.height, each.width, 3)
np.savez(sys.argv[2], **images)
info, pose, errors = client.simGetCameraInfo("0"), client.simGetVehiclePose(), []
for call in (
    lambda: client.simGetImages([airsim.ImageRequest("0", types.SurfaceNormals, True)]),
    lambda: client.simGetImages([airsim.ImageRequest("left", types.Infrared, True)]),
    lambda: client.simSetVehiclePose(airsim.Pose(airsim.Vector3r(0, 0, 0), airsim.Quaternionr(0, 0, 0, 0)), True),
    lambda: client.simGetCollisionInfo(),
):
    try:
        call()
    except Exception as error:
        errors.append(str(error))
numbers = [vars(pose.position), vars(pose.orientation)]
print(json.dumps({"fov": info.fov, "matrix": info.proj_mat.matrix, "pose": numbers, "errors": errors}))
