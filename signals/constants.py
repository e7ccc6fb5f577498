"""Constants of nature, of WGS-84 and of the GPS interface: their one home."""

C_MPS = 299_792_458.0
"""Speed of light (IS-GPS-200 20.3.3.4.3)"""
PI_GPS = 3.1415926535898
"""pi as the GPS interface fixes it (IS-GPS-200 20.3.3.4.3.3)"""
GM_GPS = 3.986005e14
"""Earth's gravitational parameter for GPS orbits [m3/s2] (IS-GPS-200 table 20-IV)"""
GM_EARTH = 3.986004418e14
"""Earth's gravitational parameter, WGS-84 (NGA.STND.0036) [m3/s2]"""
OMEGA_EARTH = 7.2921151467e-5
"""Earth's rotation rate (IS-GPS-200 table 20-IV) [rad/s]"""
F_RELATIVITY = -4.442807633e-10
"""-2 sqrt(GM) / c^2 (IS-GPS-200 20.3.3.3.3.1) [s / sqrt(m)]"""
WGS84_A = 6_378_137.0
"""Semi-major axis [m]"""
WGS84_F = 1.0 / 298.257223563
"""Flattening"""
WGS84_E2 = WGS84_F * (2.0 - WGS84_F)
"""First eccentricity squared"""
WGS84_J2 = 1.082629821e-3
"""Second zonal harmonic (NGA.STND.0036, from C20)"""
STANDARD_GRAVITY = 9.80665
"""One g, the unit of sensor data sheets [m/s2]"""
GPS_L1_HZ = 1_575_420_000.0
"""L1 carrier (IS-GPS-200 3.3.1.1)"""
GPS_L2_HZ = 1_227_600_000.0
"""L2 carrier (IS-GPS-200 3.3.1.1)"""
GPS_L5_HZ = 1_176_450_000.0
"""L5 carrier (IS-GPS-705 3.3.1.1), and that of Galileo E5a (Galileo OS SIS ICD 2.1)"""
BEIDOU_B1I_HZ = 1_561_098_000.0
"""B1I carrier (BDS-SIS-ICD-B1I 4.2.1)"""
CA_CHIP_RATE_HZ = 1_023_000.0
"""C/A code (IS-GPS-200 3.3.2.3)"""
WEEK_S = 604_800.0
"""Seconds in a GPS week"""
