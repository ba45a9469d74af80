"""The five XC330 servos: torque mode, current-limited position mode, limits and gear friction of the arm's joints."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim_backend import layout as at
from sim_backend.compiled import compiled

Array = NDArray[np.float64]


@compiled()
def joint_torque(x: Array, p: Array, u: Array, k: int, angle: float, rate: float) -> float:
    """Torque of joint servo ``k`` at its output, N m, at this angle (rad) and rate (rad/s); sets its current in ``x``.

    The motor gives at most the stall torque, and where it drives, what the torque-speed line leaves. Friction of the
    gear is Coulomb (regularised near standstill) and viscous. The current is the supply's: motor current times
    duty cycle, the duty being what overcomes resistance and back-EMF. An ideal servo has no friction, and shows the
    motor current, which is proportional to the torque. With play in the gear the motor turns by itself between the
    teeth; the encoder sits at the output.
    """
    stall = float(p[at.STALL_TORQUE])
    ideal = p[at.SERVO_IDEAL] != 0.0
    play = p[at.BACKLASH] > 0.0
    turning = x[at.MOTOR_RATE + k] if play else rate
    speed = turning / p[at.NO_LOAD_SPEED]
    motor = 0.0
    if u[at.U_TORQUE_ON] != 0.0 and u[at.U_LIMP + k] == 0.0:
        limit = stall
        if u[at.U_POSITION_MODE] != 0.0:
            motor = p[at.SERVO_STIFFNESS] * (u[at.U_GOAL + k] - angle) - p[at.SERVO_DAMPING] * rate
            limit = min(stall, u[at.U_CURRENT_LIMIT] * stall / p[at.STALL_CURRENT])
        else:
            motor = u[at.U_TORQUE + k]
        high = min(limit, max(0.0, stall * (1.0 - speed)))
        low = -min(limit, max(0.0, stall * (1.0 + speed)))
        motor = float(min(max(motor, low), high))
    share = motor / stall
    if ideal:
        x[at.SERVO_CURRENT + k] = p[at.STALL_CURRENT] * share
    else:
        x[at.SERVO_CURRENT + k] = p[at.STALL_CURRENT] * share * min(1.0, abs(share + speed))
        slip = min(max(turning / p[at.FRICTION_SPEED], -1.0), 1.0)
        motor = float(motor - p[at.FRICTION_STATIC] * slip - p[at.FRICTION_VISCOUS] * turning)
    return _through_play(x, p, k, motor, rate) if play else motor


@compiled()
def _through_play(x: Array, p: Array, k: int, motor: float, rate: float) -> float:
    """What reaches the output of a gear with play, N m; moves the motor side on by one step under its torque.

    The motor side has the inertia of the rotor and turns freely within the play; at either end the teeth are a
    stiff spring-damper that pushes and never pulls. All is seen at the output; ``rate`` is the output's.
    """
    step = p[at.STEP]
    lag = x[at.SERVO_LAG + k] + step * (x[at.MOTOR_RATE + k] - rate)
    x[at.SERVO_LAG + k] = lag
    gear = 0.0
    closing = p[at.GEAR_DAMPING] * (x[at.MOTOR_RATE + k] - rate)
    if lag > p[at.BACKLASH]:
        gear = max(0.0, p[at.GEAR_STIFFNESS] * (lag - p[at.BACKLASH]) + closing)
    elif lag < -p[at.BACKLASH]:
        gear = min(0.0, p[at.GEAR_STIFFNESS] * (lag + p[at.BACKLASH]) + closing)
    x[at.MOTOR_RATE + k] += step * (motor - gear) / p[at.MOTOR_INERTIA]
    return float(gear)


@compiled()
def stop_torque(p: Array, k: int, angle: float, rate: float) -> float:
    """Torque of the mechanical stops on joint ``k``, N m: a spring-damper beyond either limit."""
    over = angle - p[at.JOINT_MAX + k]
    if over > 0.0:
        return float(min(0.0, -p[at.STOP_STIFFNESS] * over - p[at.STOP_DAMPING] * rate))
    under = p[at.JOINT_MIN + k] - angle
    if under > 0.0:
        return float(max(0.0, p[at.STOP_STIFFNESS] * under - p[at.STOP_DAMPING] * rate))
    return 0.0


@compiled()
def tool_servos(x: Array, p: Array, u: Array) -> None:
    """Advance pump and gripper by one step: first-order towards the goal, no faster than the no-load speed."""
    for k in range(2):
        driven = u[at.U_TORQUE_ON] != 0.0 and u[at.U_LIMP + 3 + k] == 0.0
        most = p[at.NO_LOAD_SPEED] * p[at.STEP] if driven else 0.0
        move = p[at.TOOL_SERVO_GAIN] * (u[at.U_GOAL + 3 + k] - x[at.PUMP + k])
        move = min(max(move, -most), most)
        x[at.PUMP + k] += move
        x[at.TOOL_SERVO_RATE + k] = move / p[at.STEP]
