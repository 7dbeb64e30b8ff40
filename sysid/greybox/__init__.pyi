from thermogrip.sysid.greybox.fit import fit_network as fit_network
from thermogrip.sysid.greybox.posterior import Posterior as Posterior
from thermogrip.sysid.greybox.posterior import sample_posterior as sample_posterior
