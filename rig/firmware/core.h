// The rig's firmware without pins: what it answers, and when it switches off.
//
// Plain C++11, no Arduino header, no heap, no floating point in what the host compares.  The sketch calls
// receive() with each byte, sample() ten times a second, and applies outputs() after either.
// docs/reference/protocol.md is the specification; rig/device_core.py does the same in Python, and tests feed both
// the same bytes.

#ifndef THERMOGRIP_CORE_H
#define THERMOGRIP_CORE_H

#include <stddef.h>
#include <stdint.h>

namespace thermogrip {

const char VERSION[] = "0.1.0";
const size_t MAX_BODY = 160;      // bytes of a line before its star
const size_t CHECK = 11;          // bytes of *LLCCCCRRRR
const size_t MAX_LINE = MAX_BODY + CHECK + 2;  // with the end of line and the end of the string
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
  bool tachometer;  // the pump tells that it turns
};

// A sensor's value: 1e-3 degC, or one of these.
const int32_t OPEN = INT32_MAX;
const int32_t SHORTED = INT32_MIN;

struct Outputs {
  bool enable;  // supply of the drivers
  int32_t drive[MAX_DRIVES];
  bool pump, grip;
};

// CRC-16 of n bytes: polynomial 0x1021, start 0xFFFF.
uint16_t crc16(const char *data, size_t n, bool backwards);

class Core {
 public:
  // cause: power, external, brownout, watchdog, software or unknown; boot: how many resets there were.
  void begin(const Board &board, const char *cause, uint16_t boot, uint32_t now_ms);

  // Take one byte; the answer (or nothing) stands in answer() until the next call.
  void receive(char byte, uint32_t now_ms);
  const char *answer() const { return answer_; }

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
  struct Watch {
    Kind kind;
    uint8_t count;
    Kind latched;
  };

  void line(uint32_t now_ms);
  const char *check(size_t n) const;
  const char *obey(char **words, size_t n, bool *hello, uint32_t now_ms);
  const char *set_drive(char **words, size_t n, uint32_t now_ms);
  void write_identity();
  void write_state(uint32_t now_ms);
  void write_faults();
  void switch_off(Mode mode);
  bool latched() const { return n_latched_ > 0; }
  void latch(uint8_t which);
  Kind kind_of(const Sensor &sensor, int32_t value) const;

  void start(uint32_t seq);
  void put(const char *text);
  void put(char c);
  void put_number(int32_t value);
  void put_unsigned(uint32_t value);
  void finish();

  Board board_;
  const char *cause_;
  uint16_t boot_;
  uint32_t started_ms_, expires_ms_, flow_ms_;
  Mode mode_;
  int32_t drive_[MAX_DRIVES];
  bool pump_, grip_, greeted_, pump_latched_;
  Watch watches_[MAX_SENSORS];
  uint8_t latches_[MAX_SENSORS + 1];  // in the order in which they came; MAX_SENSORS is the pump
  uint8_t n_latched_;
  int32_t values_[MAX_SENSORS];
  char in_[MAX_LINE + 1];
  size_t n_in_;
  char answer_[MAX_LINE + 1], kept_[MAX_LINE + 1];
  size_t n_out_;
  bool have_last_;
  uint32_t last_;
};

// Thermistor on a divider against a fixed resistor, 10-bit converter: 1e-3 degC, OPEN or SHORTED.
int32_t thermistor(uint16_t counts, float fixed_ohm, float r25_ohm, float beta_K, bool thermistor_low);

}  // namespace thermogrip

#endif
