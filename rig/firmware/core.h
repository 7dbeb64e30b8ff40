// The rig's firmware without pins: what it answers, and when it switches off.
//
// Plain C++11, no Arduino header, no heap, no floating point in what the host compares, and an int may have 16
// bits.  The sketch calls receive() with each byte, sample() ten times a second, and applies
// outputs() after each of them.
// docs/reference/protocol.md is the specification; rig/firmware/reference.py does the same in Python, and tests feed both
// the same bytes.

#ifndef THERMOGRIP_CORE_H
#define THERMOGRIP_CORE_H

#include <stddef.h>
#include <stdint.h>

#include "line.h"

namespace thermogrip {

const char VERSION[] = "0.2.0";
const uint32_t SERIALS = 100000000;  // a board's number is below
const size_t MAX_SHORT = 56;  // bytes of a line that answers no question
const uint8_t MAX_DRIVES = 2;
const uint8_t MAX_SENSORS = 4;
const uint32_t MAX_TTL_MS = 2000;
const uint32_t PUMP_STALL_MS = 3000;
const uint8_t BAD_SAMPLES = 4;  // in a row, to latch

// What is wired: edit config.h, not this.
struct Channel {
  const char *name;
  const char *unit;
  int32_t low, high;  // 1e-4 of the unit
};

struct Sensor {
  const char *name;
  int32_t low, high;  // 1e-3 degC, where it is guarded
  bool guarded;
};

struct Board {
  Channel drives[MAX_DRIVES];
  uint8_t n_drives;
  Sensor sensors[MAX_SENSORS];
  uint8_t n_sensors;
  bool pump;        // must run before anything is driven
  bool tachometer;  // the pump reports that it turns
};

// The longest lines that a board can give, without star and check: config.h asserts that they fit.  What did not
// would be cut off, and a temperature that lost its last digits is another temperature.
constexpr size_t length_of(const char *text) { return *text == '\0' ? 0 : 1 + length_of(text + 1); }
constexpr size_t digits(int64_t n) { return n < 0 ? 1 + digits(-n) : n < 10 ? 1 : 1 + digits(n / 10); }
constexpr size_t larger(size_t a, size_t b) { return a > b ? a : b; }
constexpr size_t names(const Board &b, uint8_t k = 0) {  // "t_tank,t_surface,"
  return k == b.n_sensors ? 0 : length_of(b.sensors[k].name) + 1 + names(b, static_cast<uint8_t>(k + 1));
}
constexpr size_t channels(const Board &b, uint8_t k = 0) {  // "drive:1:-10000:10000,"
  return k == b.n_drives ? 0
                         : length_of(b.drives[k].name) + length_of(b.drives[k].unit) + digits(b.drives[k].low) +
                               digits(b.drives[k].high) + 4 + channels(b, static_cast<uint8_t>(k + 1));
}
constexpr size_t faults(const Board &b, uint8_t k = 0) {  // "short:t_tank,"
  return k == b.n_sensors ? 0
                          : (b.sensors[k].guarded ? 7 + length_of(b.sensors[k].name) : 0) +
                                faults(b, static_cast<uint8_t>(k + 1));
}
constexpr size_t driven(const Board &b, uint8_t k = 0) {  // "-10000,"
  return k == b.n_drives ? 0
                         : larger(digits(b.drives[k].low), digits(b.drives[k].high)) + 1 +
                               driven(b, static_cast<uint8_t>(k + 1));
}
constexpr size_t longest_identity(const Board &b) {  // 65535 ok thermogrip/1 0.2.0+12345678 CHANNELS pump NAMES
  return 5 + 4 + 13 + sizeof VERSION + digits(SERIALS) + channels(b) + (b.pump ? 5 : 2) + names(b) - 1;
}
constexpr size_t longest_state(const Board &b) {  // 65535 ok expired UPTIME watchdog BOOT FAULTS 1 1 DRIVES VALUES
  return 5 + 4 + 8 + 11 + 9 + 6 + larger(faults(b) + (b.tachometer ? 5 : 0) + 2 * b.n_drives, 2 + driven(b)) + 4 +
         8u * b.n_sensors - 1;  // a latched device drives 0; -273150 is the longest temperature
}

// A sensor's value: 1e-3 degC, or one of these.
const int32_t OPEN = INT32_MAX;
const int32_t SHORTED = INT32_MIN;

struct Outputs {
  bool enable;  // supply of the drivers
  int32_t drive[MAX_DRIVES];
  bool pump, grip;
};

static_assert(MAX_BODY <= 0xFF, "a line's length has two hexadecimal digits");

class Core {
 public:
  // cause: power, external, brownout, watchdog, software or unknown; boot: how many resets there were;
  // serial: of this one board, below SERIALS.
  void begin(const Board &board, const char *cause, uint16_t boot, uint32_t serial, uint32_t now_ms);

  // Take one byte; the answer (or nothing) is in answer() until the next call.  The board must outlive this.
  void receive(char byte, uint32_t now_ms);
  const char *answer() const { return said_; }

  // The line to send once after a reset.
  const char *announcement();

  // Take one sample of every sensor, and whether the pump turns.
  void sample(const int32_t *values, bool flow, uint32_t now_ms);

  // End a drive whose time is over; call it in every turn of the loop.
  void expire(uint32_t now_ms);

  Outputs outputs() const;

 private:
  enum Mode { OFF, ARMED, EXPIRED, LATCHED };
  enum Kind { GOOD, OVER, UNDER, IS_OPEN, IS_SHORT };
  struct BadCount {
    Kind kind;
    uint8_t count;
    Kind latched;
  };

  void line(uint32_t now_ms);
  const char *obey(char **words, size_t n, uint32_t now_ms);
  const char *clear();
  const char *set_drive(char **words, size_t n, uint32_t now_ms);
  void write_version();
  void write_identity();
  void write_state(uint32_t now_ms);
  void write_faults();
  void write_temperature(int32_t value);
  void switch_off(Mode mode);
  bool latched() const { return n_latched_ > 0; }
  void latch(uint8_t which);
  Kind kind_of(const Sensor &sensor, int32_t value) const;

  const Board *board_;
  const char *cause_;
  uint16_t boot_;
  uint32_t serial_;
  uint32_t started_ms_, expires_ms_, flow_ms_;
  Mode mode_;
  int32_t drive_[MAX_DRIVES];
  bool pump_, grip_, greeted_, pump_latched_;
  BadCount bad_counts_[MAX_SENSORS];
  uint8_t latches_[MAX_SENSORS + 1];  // in the order in which they came; MAX_SENSORS is the pump
  uint8_t n_latched_;
  int32_t values_[MAX_SENSORS];
  char in_[MAX_LINE];
  size_t n_in_;
  char answer_[MAX_LINE], short_[MAX_SHORT];  // to the last question, which may be repeated; and the others
  const char *said_;
  LineWriter writer_;
  bool have_last_;
  uint32_t last_;
};

// Thermistor on a divider against a fixed resistor, the sum of n readings (at most 64) of a 10-bit converter:
// 1e-3 degC, OPEN or SHORTED.
int32_t thermistor(uint16_t sum, uint8_t n, float fixed_ohm, float r25_ohm, float beta_K, bool thermistor_low);

}  // namespace thermogrip

#endif
