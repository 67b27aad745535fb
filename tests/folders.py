"""A small session folder, written by hand, with parts that a test may replace."""

from __future__ import annotations

from pathlib import Path

STAMPS = ("100.000000", "100.100000", "100.200000")
TOML = """format = 1
id = "small"
plant = "row3"
[frames]
pose = "T_world_camera"
[noise]
flower = 0.004
pixel = 0.5
depth = 0.01
"""
POSES = """# timestamp tx ty tz qx qy qz qw
100.000000 0 0 0 0 0 0 1
100.100000 0.1 0 0 0 0 0.7071067811865476 0.7071067811865476
100.200000 0.2 0.5 -1 1 0 0 0
"""
FLOWERS = """timestamp,x,y,z
100.000000,0.1,0.2,0.5
100.000000,-0.1,0.25,0.75
100.200000,0.01,-0.02,0.6
"""
COV_HEADER = "timestamp,x,y,z,score,cov_xx,cov_xy,cov_xz,cov_yy,cov_yz,cov_zz"
FLOWERS_COV = f"""{COV_HEADER}
100.000000,0.1,0.2,0.5,0.9,1e-4,2e-5,3e-5,2e-4,1e-5,4e-4
100.000000,-0.1,0.25,0.75,0.8,1e-4,0,0,1e-4,0,1e-4
100.200000,0.01,-0.02,0.6,,1e-4,0,0,1e-4,0,1e-4
"""
DETECTIONS = """timestamp,u,v,depth,score,width,height
100.000000,420,240,0.5,0.9,12,14
100.000000,320,290,1.0,0.8,12,14
100.200000,120,40,2.0,0.7,12,14
"""
CAMERA = """image_width: 640
image_height: 480
camera_name: wrist
camera_matrix:
  rows: 3
  cols: 3
  data: [400.0, 0.0, 320.0, 0.0, 500.0, 240.0, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.0, 0.0, 0.0, 0.0, 0.0]
"""
LEVEL_3 = {"session.toml": TOML, "poses.txt": POSES, "flowers.csv": FLOWERS}
LEVEL_2 = {"session.toml": TOML, "poses.txt": POSES, "detections.csv": DETECTIONS, "camera.yaml": CAMERA}


def write_folder(folder: Path, files: dict[str, str | bytes]) -> Path:
    """Write files by their names (with folders) below ``folder``, bytes as they are."""
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return folder
