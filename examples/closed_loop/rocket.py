"""A rocket in RocketPy whose canards follow the seeker: the descent, from after the burn to the ground.

RocketPy has no guided flight. Its `GenericSurface` takes coefficients as functions, which its equations of motion call
at each step. Here they read the deflections of two pairs of canards, which RocketPy's controller sets between steps.
All forces and the motion in six degrees of freedom are RocketPy's.
"""

import numpy as np
from rocketpy import Environment, Flight, GenericSurface, Rocket
from rocketpy.control.controller import _Controller
from scipy.spatial.transform import Rotation

from examples.closed_loop.seeker import Seeker, closest
from thermorender.trajectory.rotations import rotation_from_wxyz

# A rocket of the size of a student's one: radius and mass assumed.
RADIUS_M, MASS_KG, INERTIA = 0.055, 12.0, (2.4, 2.4, 0.02)
# Canards: change of lift with incidence [1/rad], referred to the rocket's section; largest deflection [rad].
CANARD_SLOPE, MOST_RAD = 5.0, 0.3
# Deflection for a specific force in steady flight [rad per m/s² at 100 m/s], from flights with a constant deflection,
# and for the error of the rate [rad per rad/s].
GAIN, DAMPING = 0.0055, 0.1
# Rate of the camera, and the canards' steps for each frame.
RATE_HZ, STEPS = 15.0, 8
SPEED_M_S, DIVE_DEG = 110.0, 50.0


def made(deflection):
    """Return the Rocket; its canards read `deflection`, a list of angles along body x and y [rad]."""
    rocket = Rocket(RADIUS_M, MASS_KG, INERTIA, 0.4, 0.4, center_of_mass_without_motor=0.0)
    rocket.add_nose(length=0.4, kind="ogive", position=1.2)
    rocket.add_trapezoidal_fins(n=4, root_chord=0.14, tip_chord=0.07, span=0.1, position=-0.75)

    def lift(alpha, beta, mach, reynolds, pitch_rate, yaw_rate, roll_rate):
        return CANARD_SLOPE * (alpha - deflection[1])

    def side(alpha, beta, mach, reynolds, pitch_rate, yaw_rate, roll_rate):
        return CANARD_SLOPE * (deflection[0] - beta)

    canards = GenericSurface(np.pi * RADIUS_M**2, 2.0 * RADIUS_M, {"cL": lift, "cQ": side}, name="canards")
    rocket.add_surfaces(canards, 0.6)
    return rocket


def start(position, heading_deg, dive_deg=DIVE_DEG, speed=SPEED_M_S):
    """Return RocketPy's initial solution: the axis along the velocity, the body's y axis down."""
    heading, dive = np.deg2rad([heading_deg, dive_deg])
    forward = np.array([np.sin(heading) * np.cos(dive), np.cos(heading) * np.cos(dive), -np.sin(dive)])
    right = np.array([np.cos(heading), -np.sin(heading), 0.0])
    body = Rotation.from_matrix(np.column_stack([right, np.cross(forward, right), forward]))
    return [0.0, *position, *(speed * forward), *np.roll(body.as_quat(), 1), 0.0, 0.0, 0.0]


def fly(session, focal_px, target, position, heading_deg, ground_m=0.0):
    """Fly once and return {"miss_m", "path" (n, 3), "seen" share of frames with the spot}.

    Parameters
    ----------
    session : thermorender.apps.link.Session or None
        With attitude "camera": RocketPy's body axes are those of a camera that looks along the rocket. None: the
        canards stay in the middle.
    focal_px : float
    target : (3,) array
        For the miss distance only [m].
    position : (3,) array
        Of the start [m].
    heading_deg : float
        Of the start, clockwise from north.
    ground_m : float
        Height at which the flight ends.
    """
    deflection, seeker, seen, taken = [0.0, 0.0], Seeker.of(session, focal_px), [], []

    def control(time_s, rate, state, history, observed, objects):
        step = round(time_s * RATE_HZ * STEPS)
        if session is None or (taken and step <= taken[-1]):
            return
        taken.append(step)
        velocity = np.asarray(state[3:6])
        if step % STEPS == 0:
            reply = session.frame(time_s, [*state[:3], *state[6:10]], products=("counts",))
            seeker.look(time_s, reply.counts, state[6:10], state[10:13])
            seen.append(seeker.run > 0)
        body = rotation_from_wxyz(state[6:10]).apply(seeker.acceleration(velocity), inverse=True)
        speed = np.linalg.norm(velocity)
        gain = GAIN * (100.0 / speed) ** 2
        # A positive rate about x turns the nose to −y, about y to +x.
        turn = np.array([body[0] / speed - state[11], body[1] / speed + state[10]])
        deflection[:] = np.clip(gain * body[:2] + DAMPING * turn, -MOST_RAD, MOST_RAD)

    rocket = made(deflection)
    rocket._add_controllers(_Controller(None, control, RATE_HZ * STEPS))
    flight = Flight(
        rocket, Environment(elevation=ground_m), rail_length=1.0, initial_solution=start(position, heading_deg),
        max_time=30.0, rtol=1e-4, max_time_step=0.05,
    )  # fmt: skip
    path = np.asarray([row[1:4] for row in flight.solution])
    return {"miss_m": closest(path, target), "path": path, "seen": float(np.mean(seen or [0.0]))}
