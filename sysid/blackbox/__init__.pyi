from thermogrip.sysid.blackbox.fit import BLACK_BOXES as BLACK_BOXES
from thermogrip.sysid.blackbox.fit import fit_black_box as fit_black_box
