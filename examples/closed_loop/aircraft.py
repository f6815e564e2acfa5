"""An aircraft in JSBSim that the seeker leads to a hot spot on the ground: bank to turn, elevator for the load factor.

The aircraft is JSBSim's own model c172x. JSBSim flies on the WGS 84 ellipsoid; places go to the server as latitude,
longitude and height, attitudes as a quaternion of the vehicle.
"""

import os

import jsbsim
import numpy as np
from scipy.spatial.transform import Rotation

from examples.closed_loop.seeker import Seeker, closest
from thermorender.trajectory.rotations import BODY_FROM_CAMERA, ENU_FROM_NED, rotation_from_angles, wxyz

FOOT_M = 0.3048
# Steps of JSBSim per second, and for each frame.
STEP_HZ, STEPS = 120, 8
RATE_HZ = STEP_HZ / STEPS
SPEED_M_S, DIVE_DEG, THROTTLE = 50.0, 18.0, 0.1
# Height of the aircraft on its wheels [m].
GROUND_M = 1.4
MOST_BANK = np.deg2rad(50.0)
# Gains: aileron for bank [1/rad] and roll rate [s/rad], elevator for the load factor [1, 1/s] and pitch rate [s/rad].
BANK, ROLL, LOAD, LOAD_SUM, PITCH = 0.9, 0.25, 0.12, 0.35, 0.45


def started(frame, position, heading_deg):
    """Return JSBSim in flight at a place (3,) east, north, up [m] of a LocalFrame."""
    jsb = jsbsim.FGFDMExec(None)
    jsb.set_debug_level(0)
    jsb.load_model("c172x")
    # The model would write a table into the working folder.
    jsb.set_output_filename(0, os.devnull)
    jsb.set_dt(1.0 / STEP_HZ)
    latitude, longitude, height = frame.geodetic_from_enu(np.asarray(position, float))
    jsb["ic/lat-geod-deg"], jsb["ic/long-gc-deg"] = float(latitude), float(longitude)
    # Without terrain JSBSim's sea level is the ellipsoid.
    jsb["ic/h-sl-ft"] = float(height) / FOOT_M
    jsb["ic/vt-fps"], jsb["ic/psi-true-deg"] = SPEED_M_S / FOOT_M, heading_deg
    jsb["ic/gamma-deg"], jsb["ic/theta-deg"] = -DIVE_DEG, -DIVE_DEG
    jsb.run_ic()
    jsb["propulsion/set-running"] = -1
    jsb["fcs/throttle-cmd-norm"], jsb["fcs/mixture-cmd-norm"] = THROTTLE, 1.0
    return jsb


def fly(session, frame, focal_px, target, position, heading_deg, most_s=30.0):
    """Fly once and return {"miss_m", "path" (n, 3), "seen" share of frames with the spot}.

    Parameters
    ----------
    session : thermorender.apps.link.Session or None
        With position "wgs84" and attitude "body". None: the wings are kept level, at one g.
    frame : LocalFrame
        Of the scene.
    focal_px : float
    target : (3,) array
        For the miss distance and the end of the flight only [m].
    position, heading_deg : (3,) array, float
        Of the start [m], clockwise from north.
    most_s : float
        Longest flight [s].
    """
    jsb, seeker, seen, path, total = started(frame, position, heading_deg), Seeker.of(session, focal_px), [], [], 0.0
    for step in range(int(most_s * STEP_HZ)):
        place = [jsb["position/lat-geod-deg"], jsb["position/long-gc-deg"], jsb["position/geod-alt-ft"] * FOOT_M]
        path.append(frame.enu_from_geodetic(*place))
        height, away = path[-1][2] - target[2], np.linalg.norm(path[-1] - target)
        if height <= GROUND_M or (step and away > np.linalg.norm(path[-2] - target) and away < 60.0):
            break
        ned = rotation_from_angles(*(np.rad2deg(jsb[f"attitude/{name}-rad"]) for name in ("psi", "theta", "phi")))
        rates = np.array([jsb[f"velocities/{name}-rad_sec"] for name in "pqr"])
        north, east, down = (jsb[f"velocities/v-{name}-fps"] * FOOT_M for name in ("north", "east", "down"))
        if session is not None and step % STEPS == 0:
            reply = session.frame(step / STEP_HZ, [*place, *wxyz(ned)], products=("counts",))
            camera = Rotation.from_matrix(ENU_FROM_NED) * ned * Rotation.from_matrix(BODY_FROM_CAMERA)
            seeker.look(step / STEP_HZ, reply.counts, wxyz(camera), rates[[1, 2, 0]])
            seen.append(seeker.run > 0)
        total = steer(jsb, seeker, np.array([east, north, -down]), rates, total)
        jsb.run()
    return {"miss_m": closest(np.array(path), target), "path": np.array(path), "seen": float(np.mean(seen or [0.0]))}


def steer(jsb, seeker, velocity, rates, total):
    """Set the control surfaces, and return the new sum of the error of the load factor."""
    forward = velocity / np.linalg.norm(velocity)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    wanted = seeker.acceleration(velocity)
    if not wanted.any():
        wanted = 9.80665 * up
    lift, side = max(float(wanted @ up), 1.0), float(wanted @ right)
    bank = np.clip(np.arctan2(side, lift), -MOST_BANK, MOST_BANK)
    load = np.clip(lift / np.cos(bank) / 9.80665, 0.0, 3.0)
    error = load - jsb["accelerations/Nz"]
    total = float(np.clip(total + error / STEP_HZ, -1.0, 1.0))
    jsb["fcs/aileron-cmd-norm"] = float(np.clip(BANK * (bank - jsb["attitude/phi-rad"]) - ROLL * rates[0], -1.0, 1.0))
    pull = LOAD * error + LOAD_SUM * total - PITCH * (rates[1] - (load - 1.0) * 9.80665 / np.linalg.norm(velocity))
    # A negative elevator raises the nose.
    jsb["fcs/elevator-cmd-norm"] = float(np.clip(-pull, -1.0, 1.0))
    jsb["fcs/rudder-cmd-norm"] = float(np.clip(-0.5 * jsb["aero/beta-rad"], -0.5, 0.5))
    return total
