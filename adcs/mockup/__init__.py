"""The table-top satellite: a camera that looks up at a sky of LEDs, an inertial unit in the plane, and their fusion.

The table's frame has X and Y in the plane and Z up [m]. The heading φ is counter-clockwise seen from above,
v_table = R(φ) v_body with R(φ) = [[cos φ, -sin φ], [sin φ, cos φ]], and the gyro reads dφ/dt.

Source: Bindel, Ivanov, Nuzhdin, Ovchinnikov, Trofimov, Keldysh Institute preprint.
"""
