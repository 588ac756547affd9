"""
Bit error rate of an OFDM link
==============================

`links.cfr` returns the channel of each link at the subcarriers of an OFDM signal; the rest of a link simulator is
NumPy. Here, QPSK on the 792 subcarriers of a channel of 100 MHz at 28 GHz, in an apartment: how much power does a link
without line of sight need?
"""

import numpy as np
from matplotlib.figure import Figure
from scipy.special import erfc

import sionna_partial as sp
from sionna_partial.resources import scenes_folder

SUBCARRIERS_HZ = 120e3 * np.arange(-396, 396)
NOISE_DBM = -174.0 + 10 * np.log10(120e3) + 7.0  # of one subcarrier, with a noise figure of 7 dB
TX_POWER_DBM = np.arange(-30.0, 32.0, 4.0)  # of the whole signal

home = sp.load_map(scenes_folder() / "apartment" / "complete" / "map.yaml")
links = sp.trace_links(home, (7.0, 9.8, 1.5), [(8.0, 10.0, 1.5), (8.0, 7.0, 1.5)])

# %%
# The simulation takes anything with `cfr`: it draws bits, sends them through the channel of each subcarrier, adds
# noise, removes the phase of the channel, and decides by the sign.


def bit_error_rate(channels: sp.TracedLinks, tx_power_dbm: float, symbols: int = 100, seed: int = 0) -> np.ndarray:
    """Return the bit error rate of each link."""
    gain = channels.cfr(SUBCARRIERS_HZ).h.to_numpy()[:, 0, 0]
    rng, shape = np.random.default_rng(seed), (symbols, *gain.shape)
    sent = rng.choice([-1, 1], shape) + 1j * rng.choice([-1, 1], shape)
    amplitude = np.sqrt(10 ** (tx_power_dbm / 10) / len(SUBCARRIERS_HZ) / 2)
    noise = np.sqrt(10 ** (NOISE_DBM / 10) / 2) * (rng.normal(size=shape) + 1j * rng.normal(size=shape))
    found = (amplitude * gain * sent + noise) * gain.conj()
    wrong = (np.sign(found.real) != sent.real).astype(float) + (np.sign(found.imag) != sent.imag)
    return wrong.mean(axis=(0, 2)) / 2


simulated = np.array([bit_error_rate(links, power_dbm) for power_dbm in TX_POWER_DBM])
gain_db = 20 * np.log10(np.abs(links.cfr(SUBCARRIERS_HZ).h.to_numpy()[:, 0, 0]))
snr_db = TX_POWER_DBM[:, None, None] - 10 * np.log10(len(SUBCARRIERS_HZ)) + gain_db - NOISE_DBM
expected = erfc(np.sqrt(10 ** (snr_db / 10) / 2)).mean(axis=2) / 2
print(f"largest difference from theory: {np.abs(simulated - expected).max():.4f}")
assert np.abs(simulated - expected).max() < 0.005
for i, state in enumerate(links.link_state):
    needed = TX_POWER_DBM[np.argmax(expected[:, i] < 1e-3)]
    print(f"link {i}, {sp.LinkState(state).name}: bit error rate below 0.001 from {needed:.0f} dBm")

# %%
# Left, the channels: the paths of the second link cancel each other at some subcarriers. Right, the bit error rates:
# dots are simulated, lines the theory of QPSK on these channels.

figure = Figure(figsize=(9, 3.4), layout="constrained")
left, right = figure.subplots(1, 2)
for i, color in enumerate(("tab:blue", "tab:orange")):
    label = f"link {i}, {sp.LinkState(links.link_state[i]).name}"
    left.plot(SUBCARRIERS_HZ / 1e6, gain_db[i], color=color, label=label)
    right.semilogy(TX_POWER_DBM, expected[:, i].clip(1e-12), color=color)
    right.semilogy(TX_POWER_DBM, np.where(simulated[:, i] > 0, simulated[:, i], np.nan), "o", color=color)
left.set(xlabel="frequency from the carrier [MHz]", ylabel="gain [dB]")
left.legend()
right.set(xlabel="transmitted power [dBm]", ylabel="bit error rate", ylim=(1e-5, 1))

# %%
# On a map that shows half of the apartment the channel is not known: `sample_channels` draws possible ones. Bit error
# rates of the second link over 100 draws tell how much power is enough.

partial = sp.load_map(scenes_folder() / "apartment" / "step100" / "map.yaml")
samples = sp.channels.sample_channels(partial, (7.0, 9.8, 1.5), [(8.0, 10.0, 1.5), (8.0, 7.0, 1.5)], n=100)
drawn = np.abs(samples.cfr(SUBCARRIERS_HZ).h.to_numpy()[:, 1, 0, 0]) ** 2
power = 10 ** (TX_POWER_DBM / 10) / len(SUBCARRIERS_HZ) / 10 ** (NOISE_DBM / 10)
of_draws = erfc(np.sqrt(power[:, None, None] * drawn / 2)).mean(axis=2) / 2
needed = np.where((of_draws < 1e-3).any(axis=0), TX_POWER_DBM[np.argmax(of_draws < 1e-3, axis=0)], np.inf)
for probability in (0.5, 0.9):
    print(f"with probability {probability:.0%}, {np.quantile(needed, probability, method='higher'):.0f} dBm are enough")
