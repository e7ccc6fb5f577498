"""GNSS signals from satellite to correlator tap.  Makes no receiver decision.

Conventions, said once.

Time
    Sample n is taken when the receiver clock reads t0 + n/fs.  GPS time is that minus b
    (b > 0: the receiver clock is ahead).  ``t_s`` everywhere is receiver time since t0, the
    nominal start (``start_week``, ``start_tow_s``).
Pseudorange
    rho = r + c (b - b_sv); r is geometric range with the Sagnac effect, b_sv the satellite's
    clock correction for L1 users (polynomial + relativity - T_GD).
Doppler
    doppler_hz = -rho_dot f / c: positive when approaching.
Carrier
    z = exp(+j 2 pi (f_IF t + carrier_phase_cycles)) with carrier_phase_cycles = -rho f / c: it
    grows with positive Doppler (RINEX carrier phase has the opposite sign).
Code
    code_phase_chips grows with time; it is the chip under reception: chip_rate (t - rho / c) plus
    a constant of the run (`propagation.SignalState`).
Taps
    A tap at offset d > 0 chips is a replica *delayed* by d (late), d < 0 early.
Errors
    error = true - estimate; C_true = (I + [psi x]) C_est.
Frames
    r_eb_e: position of b with respect to e, resolved in e (ECEF, WGS-84).  Body axes are
    forward-right-down; n is north-east-down; ``C_b_e`` takes body to ECEF.
Units
    SI and radians unless the name says otherwise: _chips _cycles _hz _dbhz _deg.
"""
