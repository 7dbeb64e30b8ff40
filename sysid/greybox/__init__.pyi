from thermogrip.sysid.greybox.fit import fit_network as fit_network
from thermogrip.sysid.greybox.population import Population as Population
from thermogrip.sysid.greybox.population import pool_rigs as pool_rigs
from thermogrip.sysid.greybox.posterior import Posterior as Posterior
from thermogrip.sysid.greybox.posterior import sample_posterior as sample_posterior
