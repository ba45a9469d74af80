"""Where each quantity stands in the flat arrays that the kernels of the worlds work on.

``x`` is the state of the world, ``p`` its constants, ``u`` what drives it. Three arrays keep the call of a kernel
cheap; the indices below are compile-time constants.
"""

from __future__ import annotations

# ---- x: state -----------------------------------------------------------------------------------------------------
POSITION = 0  # 3, m, W
VELOCITY = 3  # 3, m/s, W
ATTITUDE = 6  # 4, q_WB
RATE = 10  # 3, rad/s, B
JOINT = 13  # 3, rad
JOINT_RATE = 16  # 3, rad/s
ACCELERATION = 19  # 9: of the origin (W), of the body rate (B), of the joints, at the last step
ROTOR = 28  # 4, thrust, N
PUMP = 32  # rad
GRIPPER = 33  # rad
CHARGE = 34  # battery charge left, 0..1
VOLTAGE = 35  # V
PAYLOAD = 36  # 1 while the sleeve is in the gripper
SLEEVE_ON_PIPE = 37  # 1 once it was left there
CONTACT_MODE = 38  # bristle mode of the tip on the pipe
CONTACT_STRETCH = 39  # 2, bristle stretch along the circumference and along the axis, m
TIP_SLIP = 41  # m
CONTACT_FORCE = 42  # N, along the outward normal
CONTACT_PEAK = 43  # N, since the last advance began
CONTACT_VECTOR = 44  # 3, N, W
SPECIFIC_FORCE_SUM = 47  # 3, sum over the steps of the advance, m/s^2, B
JOINT_TORQUE = 50  # 3, N m, at the output
SERVO_CURRENT = 53  # 3, A
ON_GROUND = 56  # 1 while anything touches: a limp arm may carry what the skids do not
CRASH = 57  # 0, or a code of array_plant.CRASHES
CRASH_VALUE = 58
RATE_INTEGRAL = 59  # 3, N m, of the autopilot's rate loop
PHASE = 62  # physics steps since the inner loops ran
ROTOR_LIMIT = 63  # N, what the battery's voltage lets one rotor give
TIP = 64  # 3, gripper tip, m, W
NEEDLE_TIP = 67  # 3, m, W
TOOL_SERVO_RATE = 70  # 2, pump and gripper, rad/s
GROUND_BRISTLE = 72  # GROUND_POINTS x (mode, stretch x, stretch y)
GROUND_POINTS = 12  # 4 skids, 4 rotor hubs, elbow, wrist, gripper tip, needle tip
ROTOR_ANGLE = GROUND_BRISTLE + 3 * GROUND_POINTS  # 4, rad, turned by each rotor without its sign
SERVO_LAG = ROTOR_ANGLE + 4  # 3, rad, motor side less output of each joint servo, seen at the output
MOTOR_RATE = SERVO_LAG + 3  # 3, rad/s, of the motor side, seen at the output
STATE_SIZE = MOTOR_RATE + 3

# ---- p: constants -------------------------------------------------------------------------------------------------
STEP = 0  # s
GRAVITY = 1
DRAG = 2  # 3
MOUNT = 5  # 3
LINK_1 = 8
LINK_2 = 9
TOOL = 10
NEEDLE = 11
JOINT_MIN = 12  # 3
JOINT_MAX = 15  # 3
STOP_STIFFNESS = 18
STOP_DAMPING = 19
ROTOR_X = 20
ROTOR_Y = 21
ROTOR_MAX = 22
ROTOR_YAW = 23  # N m per N
ROTOR_GAIN = 24  # share of the way to the demand in one step
ROTOR_RADIUS = 25
STALL_TORQUE = 26
STALL_CURRENT = 27
NO_LOAD_SPEED = 28
FRICTION_STATIC = 29
FRICTION_VISCOUS = 30
FRICTION_SPEED = 31
SERVO_STIFFNESS = 32
SERVO_DAMPING = 33
SERVO_IDEAL = 34
TOOL_SERVO_GAIN = 35  # share of the way to the goal in one step, pump and gripper
PIPE_POINT = 36  # 3
PIPE_NORMAL = 39  # 2, x and y of the heading
PIPE_RADIUS = 41
CONTACT_STIFFNESS = 42
CONTACT_DAMPING = 43
CONTACT_TANGENTIAL_STIFFNESS = 44
CONTACT_TANGENTIAL_DAMPING = 45
CONTACT_STATIC = 46
CONTACT_KINETIC = 47
RELEASE_ANGLE = 48
GROUND_STIFFNESS = 49
GROUND_DAMPING = 50
GROUND_TANGENTIAL_STIFFNESS = 51
GROUND_TANGENTIAL_DAMPING = 52
GROUND_STATIC = 53
GROUND_KINETIC = 54
GROUND_CRASH_SPEED = 55
GROUND_REACH = 56  # no point of the vehicle is below the ground while the origin is higher than this
GEAR_HEIGHT = 57
GEAR_SPAN = 58
BATTERY_FULL = 59
BATTERY_EMPTY = 60
BATTERY_RESISTANCE = 61
BATTERY_CAPACITY = 62  # A s
HOVER_CURRENT = 63
HOVER_THRUST = 64  # N, all rotors
RATED_VOLTAGE = 65  # 0: the voltage does not limit the thrust
PIPE_HALF_LENGTH = 66
ROTOR_SCALE = 67  # true thrust over the thrust demanded
BATTERY_SAG = 68  # share of the thrust's fall with the voltage that nobody makes up for
HOVER_VOLTAGE = 69  # V, full battery in hover
SPIN = 70  # rad/s per square root of N, of a rotor
ROTOR_DRAG = 71  # N s/m per rad/s
GROUND_EFFECT = 72
WALL_EFFECT = 73
BACKLASH = 74  # rad, half the play; 0: motor and output are one
GEAR_STIFFNESS = 75  # N m/rad
GEAR_DAMPING = 76  # N m s/rad
MOTOR_INERTIA = 77  # kg m^2, of the motor side, seen at the output
UNEVENNESS = 78
WAVE = 79  # 4 x (1/m along the axis, 1/m round the pipe, phase in rad)
LUMPED = 91  # 2 x LUMPED_SIZE: without and with the payload
LUMPED_SIZE = 38
# Gains of the autopilot's inner loops.
LOOP = LUMPED + 2 * LUMPED_SIZE
LOOP_ATTITUDE_GAIN = LOOP  # roll and pitch
LOOP_YAW_GAIN = LOOP + 1
LOOP_YAW_WEIGHT = LOOP + 2
LOOP_RATE_LIMIT = LOOP + 3  # roll and pitch
LOOP_YAW_RATE_LIMIT = LOOP + 4
LOOP_BANDWIDTH = LOOP + 5  # 3
LOOP_INTEGRAL_GAIN = LOOP + 8  # 3, 1/s
LOOP_INTEGRAL_LIMIT = LOOP + 11  # 3, N m
LOOP_INERTIA = LOOP + 14  # 3
LOOP_PERIOD = LOOP + 17  # s
LOOP_STEPS = LOOP + 18  # physics steps per period
LOOP_VELOCITY_GAIN = LOOP + 19
LOOP_MASS = LOOP + 20  # kg, what the autopilot takes the vehicle for
CONSTANTS_SIZE = LOOP + 21

# Offsets within one lumped set (see dynamics.py).
L_MASS = 0
L_FIRST = 1  # 3, sum m o
L_FIRST_U = 4  # 3, sum m a_k
L_CROSS = 7  # 3 x 3, sum m a_k o
L_PAIR = 16  # 11 12 13 22 23 33, sum m a_k a_l
L_INERTIA = 22  # xx yy zz xy xz yz, of everything constant in B about the origin
L_TURNING = 28  # 3 x (along, about y, across), of the parts turning with each angle
L_ROTOR = 37  # reflected rotor inertia

# ---- u: drive -----------------------------------------------------------------------------------------------------
U_ROTOR = 0  # 4, thrust demanded, N: by the inner loops, or by an autopilot outside
U_TORQUE = 4  # 3, joint torque demanded, N m
U_POSITION_MODE = 7
U_GOAL = 8  # 5, rad
U_CURRENT_LIMIT = 13  # A
U_TORQUE_ON = 14
U_SETPOINT = 15  # 0 none, 1 wrench, 2 attitude, 3 body rate, 4 velocity, 5 descent, 6 rotors
U_THRUST = 16  # N; for a velocity: downwards, m/s
U_BODY_TORQUE = 17  # 3, N m
U_ATTITUDE = 20  # 4
U_BODY_RATE = 24  # 3
U_LIMP = 27  # 5, 1 while that servo's own torque is off
U_VELOCITY_ERROR = 32  # 3, m/s, W: what the autopilot believes its velocity to be, less what it is
U_WIND = 35  # 3, velocity of the air, m/s, W
DRIVE_SIZE = 38
