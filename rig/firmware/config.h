// What is wired to your board: the one file to edit.

#ifndef THERMOGRIP_CONFIG_H
#define THERMOGRIP_CONFIG_H

#include "core.h"

// Pins (Arduino Uno, Nano, Mega, Leonardo).
const uint8_t PIN_ENABLE = 8;   // relay or switch of the drivers' supply: low is off, also while the board starts
const uint8_t PIN_HEAT = 9;     // pulse width of the half bridges
const uint8_t PIN_COOL = 10;
const uint8_t PIN_PUMP = 7;
const uint8_t PIN_GRIP = 6;
const uint8_t PIN_TACHO = 2;    // must have an interrupt
const uint8_t PIN_SENSORS[] = {A0, A1, A2};

// Thermistors from the pin to ground, a fixed resistor from the pin to the supply.
const float FIXED_OHM = 10000.0f, R25_OHM = 10000.0f, BETA_K = 3950.0f;

// Names, units and limits: what the host sees and what trips (1e-4 of the drive's unit, 1e-3 degC).
constexpr thermogrip::Board BOARD = {
    {{"drive", "1", -10000, 10000}},
    1,
    {{"t_tank", 2000, 60000, true}, {"t_surface", 3000, 55000, true}, {"t_ambient", 0, 0, false}},
    3,
    true,   // a pump must run before anything is driven
    true,   // it has a tachometer; without one write false: nothing then notices that it has stopped
};

static_assert(BOARD.n_drives == 1, "the sketch has pins for one drive: give apply() yours");
static_assert(thermogrip::longest_identity(BOARD) <= thermogrip::MAX_BODY, "the names are too long for a line");
static_assert(thermogrip::longest_state(BOARD) <= thermogrip::MAX_BODY, "the names are too long for a line");
static_assert(BOARD.n_sensors == sizeof PIN_SENSORS, "each sensor has one pin");

#endif
