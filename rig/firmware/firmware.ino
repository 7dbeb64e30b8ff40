// thermogrip's rig: a Peltier on a half bridge, a pump, a gripper, thermistors; docs/reference/protocol.md.
//
// Everything that decides is in core.cpp, which is tested on a PC; here are the pins.  The watchdog of the chip
// resets the board when this loop hangs for a second, and a board that starts has everything off.

#include <EEPROM.h>
#include <avr/wdt.h>

#include "config.h"
#include "core.h"

using thermogrip::Core;

static const uint8_t READINGS = 8;  // of a sensor each time, 0.1 ms each
static Core core;
static uint8_t reset_flags __attribute__((section(".noinit")));
static volatile uint16_t tacho_edges = 0;
static uint32_t sampled_ms = 0;
static const char *unsent = "";

// Before anything else: why the chip was reset, and no watchdog while it starts.
void keep_reset_flags(void) __attribute__((naked, used, section(".init3")));
void keep_reset_flags(void) {
  reset_flags = MCUSR;
  MCUSR = 0;
  wdt_disable();
}

static void count_edge() { ++tacho_edges; }

static const char *cause() {
  if (reset_flags & _BV(WDRF)) return "watchdog";
  if (reset_flags & _BV(BORF)) return "brownout";
  if (reset_flags & _BV(EXTRF)) return "external";
  if (reset_flags & _BV(PORF)) return "power";
  return "unknown";  // the boot loader took the flags
}

static uint16_t next_boot() {
  uint16_t boot;
  EEPROM.get(0, boot);
  ++boot;
  EEPROM.put(0, boot);
  return boot;
}

// The number of this board, which it takes from the noise of its converter at its first start.
static uint32_t serial() {
  uint32_t number;
  EEPROM.get(2, number);
  if (number < thermogrip::SERIALS) return number;
  number = micros();
  for (uint16_t k = 0; k < 512; ++k) {
    number = 33 * number + static_cast<uint32_t>(analogRead(PIN_SENSORS[k % BOARD.n_sensors]));
  }
  number %= thermogrip::SERIALS;
  EEPROM.put(2, number);
  return number;
}

static void apply() {
  thermogrip::Outputs pins = core.outputs();
  uint8_t width = static_cast<uint8_t>(abs(pins.drive[0]) * 255L / 10000L);
  // never both sides of the bridge: the one that is off goes off first
  if (pins.drive[0] >= 0) {
    analogWrite(PIN_COOL, 0);
    analogWrite(PIN_HEAT, width);
  } else {
    analogWrite(PIN_HEAT, 0);
    analogWrite(PIN_COOL, width);
  }
  digitalWrite(PIN_PUMP, pins.pump);
  digitalWrite(PIN_GRIP, pins.grip);
  digitalWrite(PIN_ENABLE, pins.enable);
}

static void measure(int32_t *values) {
  for (uint8_t k = 0; k < BOARD.n_sensors; ++k) {
    uint16_t sum = 0;  // not their mean in whole counts, a tenth of a degC each: noise makes eight finer
    for (uint8_t i = 0; i < READINGS; ++i) sum += static_cast<uint16_t>(analogRead(PIN_SENSORS[k]));
    values[k] = thermogrip::thermistor(sum, READINGS, FIXED_OHM, R25_OHM, BETA_K, true);
  }
}

static void sample(const int32_t *values, uint32_t now_ms) {
  noInterrupts();
  bool flow = tacho_edges > 0;
  tacho_edges = 0;
  interrupts();
  core.sample(values, flow, now_ms);
}

// Measure ten times a second; whether it was time to.
static bool measure_due(uint32_t now_ms) {
  if (now_ms - sampled_ms < 100) return false;
  int32_t values[thermogrip::MAX_SENSORS];
  measure(values);
  sampled_ms = now_ms;
  sample(values, now_ms);
  return true;
}

// Hand over what the serial port has room for: a whole line at once would stop this loop for 9 ms.
static void send() {
  while (*unsent != '\0' && Serial.availableForWrite() > 0) Serial.write(*unsent++);
}

void setup() {
  const uint8_t outputs[] = {PIN_ENABLE, PIN_HEAT, PIN_COOL, PIN_PUMP, PIN_GRIP};
  for (uint8_t pin : outputs) {
    digitalWrite(pin, LOW);
    pinMode(pin, OUTPUT);
  }
  pinMode(PIN_TACHO, INPUT_PULLUP);
  attachInterrupt(digitalPinToInterrupt(PIN_TACHO), count_edge, FALLING);
  Serial.begin(115200);
  core.begin(BOARD, cause(), next_boot(), serial(), millis());
  int32_t values[thermogrip::MAX_SENSORS];
  measure(values);
  sample(values, millis());
  unsent = core.announcement();
  wdt_enable(WDTO_1S);
}

void loop() {
  wdt_reset();
  uint32_t now_ms = millis();
  core.expire(now_ms);
  bool measured = measure_due(now_ms);
  apply();
  send();
  if (measured) return;  // it takes 4 ms
  // one line at most a turn, and none before the last answer is out; samples go on however much comes in
  for (uint8_t k = 0; k < 64 && *unsent == '\0' && Serial.available() > 0; ++k) {
    core.receive(static_cast<char>(Serial.read()), now_ms);
    unsent = core.answer();
  }
  apply();
}
