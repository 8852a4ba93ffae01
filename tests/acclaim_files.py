"""A small ASF/AMC pair to break, and the way to write it."""

from pathlib import Path

ASF = """# a leg
:version 1.10
:name leg
:units
  mass 1.0
  length 0.5
  angle deg
:documentation
   begin of nothing: any words may stand here
:root
   order TX TY TZ RX RY RZ
   axis XYZ
   position 0 0 0
   orientation 0 0 0
:bonedata
  begin
     id 1
     name femur
     direction 0 -1 0
     length 2
     axis 0 0 20 XYZ
     dof rx ry rz
     limits (-160.0 20.0)
            (-70.0 70.0)
            (-inf 70.0)
  end
  begin
     id 2
     name tibia
     direction 0.6 -0.8 0
     length 3
     axis 0 0 0 XYZ
     dof rx
     limits (-10.0 170.0)
  end
  begin
     id 3
     name heel
     direction 0 0 -1
     length 0.5
     axis 0 0 0 XYZ
  end
:hierarchy
  begin
    root femur
    femur tibia
    tibia heel
  end
"""

FRAME = "{n}\nroot 1 2 3 {turn} 0 0\nfemur 10 20 30\ntibia {bend}\n"
AMC = "#!OML:ASF nowhere\n:FULLY-SPECIFIED\n:DEGREES\n" + "".join(
    FRAME.format(n=n, turn=0, bend=10 * n) for n in (1, 2, 3)
)


def write(folder: Path, name: str, text: str, end: str = "\n") -> Path:
    """The text in a file, its lines ended by ``end``."""
    path = folder / name
    path.write_bytes(text.replace("\n", end).encode())
    return path
