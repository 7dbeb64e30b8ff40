#include "core.h"

#include <math.h>
#include <string.h>

namespace thermogrip {

namespace {

const char *const MODES[] = {"off", "armed", "expired", "latched"};
const char *const KINDS[] = {"", "over", "under", "open", "short"};

bool same(const char *a, const char *b) { return strcmp(a, b) == 0; }

}  // namespace

void Core::begin(const Board &board, const char *cause, uint16_t boot, uint32_t serial, uint32_t now_ms) {
  board_ = &board;
  cause_ = cause;
  boot_ = boot;
  serial_ = serial;
  started_ms_ = now_ms;
  expires_ms_ = flow_ms_ = now_ms;
  mode_ = OFF;
  pump_ = grip_ = greeted_ = pump_latched_ = have_last_ = false;
  n_latched_ = 0;
  n_in_ = 0;
  last_ = 0;
  said_ = "";
  for (uint8_t k = 0; k < MAX_DRIVES; ++k) drive_[k] = 0;
  for (uint8_t k = 0; k < MAX_SENSORS; ++k) {
    values_[k] = OPEN;
    bad_counts_[k] = {GOOD, 0, GOOD};
  }
}

void Core::receive(char byte, uint32_t now_ms) {
  expire(now_ms);
  said_ = "";
  if (byte != '\n') {
    // one more than the longest line is kept, which shows that it is too long
    if (n_in_ < MAX_BODY + CHECK + 1) in_[n_in_++] = byte;
    return;
  }
  if (n_in_ > 0) line(now_ms);
  n_in_ = 0;
}

void Core::line(uint32_t now_ms) {
  char *words[8];
  size_t n = 0, body = n_in_ < CHECK ? 0 : n_in_ - CHECK;
  bool good = check_line(in_, n_in_) == nullptr;
  if (good) {
    in_[body] = '\0';
    for (char *at = in_; at != nullptr && n < 8; ++n) {
      words[n] = at;
      at = strchr(at, ' ');
      if (at != nullptr) *at++ = '\0';
    }
  }
  int64_t seq = 0;
  good = good && n >= 2 && integer(words[0], &seq) && seq >= 0 && seq <= 0xFFFF;
  if (!good) {
    writer_.start(short_, sizeof short_, 0);
    writer_.put(" err corrupt");
    said_ = writer_.finish();
    return;
  }
  // what a device says comes back where a line echoes: answering it would never end
  if (same(words[1], "ok") || same(words[1], "err") || same(words[1], "boot")) return;
  bool bare_hello = n == 2 && same(words[1], "hello");
  if (have_last_ && last_ == static_cast<uint32_t>(seq) && !bare_hello) {
    said_ = answer_;
    return;
  }
  const char *refusal = obey(words + 1, n - 1, now_ms);
  writer_.start(answer_, sizeof answer_, static_cast<uint32_t>(seq));
  if (refusal != nullptr) {
    writer_.put(" err ");
    writer_.put(refusal);
  } else if (bare_hello) {
    write_identity();
  } else {
    write_state(now_ms);
  }
  said_ = writer_.finish();
  have_last_ = true;
  last_ = static_cast<uint32_t>(seq);
}

// Do what is asked; return the code of a refusal, or nothing.
const char *Core::obey(char **words, size_t n, uint32_t now_ms) {
  const char *word = words[0];
  if (same(word, "drive")) return set_drive(words, n, now_ms);
  if (same(word, "grip")) {
    if (n != 2 || !(same(words[1], "0") || same(words[1], "1"))) return "syntax";
    grip_ = words[1][0] == '1';
    return nullptr;
  }
  bool hello = same(word, "hello"), off = same(word, "off"), wants_clear = same(word, "clear");
  if (!hello && !off && !wants_clear && !same(word, "read")) return "unknown";
  if (n != 1) return "syntax";
  greeted_ = greeted_ || hello;
  if (hello || off) switch_off(latched() ? LATCHED : OFF);
  return wants_clear ? clear() : nullptr;
}

const char *Core::clear() {
  for (uint8_t k = 0; k < board_->n_sensors; ++k) {
    if (bad_counts_[k].kind != GOOD) return "active";
  }
  n_latched_ = 0;
  pump_latched_ = false;
  for (uint8_t k = 0; k < board_->n_sensors; ++k) bad_counts_[k].latched = GOOD;
  switch_off(OFF);
  return nullptr;
}

const char *Core::set_drive(char **words, size_t n, uint32_t now_ms) {
  int64_t ttl, value, drive[MAX_DRIVES] = {};
  if (n != 4 || !integer(words[1], &ttl)) return "syntax";
  if (!(same(words[2], "0") || same(words[2], "1"))) return "syntax";
  bool pump = words[2][0] == '1', any = false, inside = true;
  size_t count = 0;
  for (char *at = words[3]; at != nullptr; ++count) {
    char *comma = strchr(at, ',');
    if (comma != nullptr) *comma = '\0';
    if (!integer(at, &value)) return "syntax";
    if (count < MAX_DRIVES) drive[count] = value;
    at = comma == nullptr ? nullptr : comma + 1;
  }
  if (!greeted_) return "hello";
  if (latched()) return "latched";
  if (ttl < 1 || ttl > static_cast<int64_t>(MAX_TTL_MS)) return "ttl";
  if (count != board_->n_drives) return "syntax";
  for (uint8_t k = 0; k < board_->n_drives; ++k) {
    inside = inside && drive[k] >= board_->drives[k].low && drive[k] <= board_->drives[k].high;
    any = any || drive[k] != 0;
  }
  if (!inside) return "range";
  if (board_->pump && !pump && any) return "interlock";
  for (uint8_t k = 0; k < board_->n_drives; ++k) drive_[k] = static_cast<int32_t>(drive[k]);
  if (!pump_) flow_ms_ = now_ms;  // a pump that starts has its time to turn, whatever the last one did
  pump_ = pump;
  mode_ = ARMED;
  expires_ms_ = now_ms + static_cast<uint32_t>(ttl);
  return nullptr;
}

void Core::expire(uint32_t now_ms) {
  // the clock of an Arduino wraps after 49 days: only differences are compared
  if (mode_ == ARMED && static_cast<int32_t>(now_ms - expires_ms_) >= 0) switch_off(EXPIRED);
}

Core::Kind Core::kind_of(const Sensor &sensor, int32_t value) const {
  if (!sensor.guarded) return GOOD;
  if (value == OPEN) return IS_OPEN;
  if (value == SHORTED) return IS_SHORT;
  return value > sensor.high ? OVER : value < sensor.low ? UNDER : GOOD;
}

void Core::sample(const int32_t *values, bool flow, uint32_t now_ms) {
  expire(now_ms);
  uint8_t before = n_latched_;
  for (uint8_t k = 0; k < board_->n_sensors; ++k) {
    values_[k] = values[k];
    BadCount &bad = bad_counts_[k];
    Kind kind = kind_of(board_->sensors[k], values[k]);
    bool again = kind != GOOD && kind == bad.kind;
    bad.count = static_cast<uint8_t>(again ? (bad.count < BAD_SAMPLES ? bad.count + 1 : bad.count)
                                             : kind != GOOD);
    bad.kind = kind;
    if (bad.count >= BAD_SAMPLES && bad.latched == GOOD) {
      bad.latched = kind;
      latch(k);
    }
  }
  bool driven = false;
  for (uint8_t k = 0; k < board_->n_drives; ++k) driven = driven || drive_[k] != 0;
  if (flow || !driven || !pump_) flow_ms_ = now_ms;
  bool stalled = board_->tachometer && board_->pump && now_ms - flow_ms_ >= PUMP_STALL_MS;
  if (stalled && !pump_latched_) {
    pump_latched_ = true;
    latch(MAX_SENSORS);
  }
  if (n_latched_ > before) switch_off(LATCHED);
}

void Core::latch(uint8_t which) {
  if (n_latched_ < MAX_SENSORS + 1) latches_[n_latched_++] = which;
}

void Core::switch_off(Mode mode) {
  for (uint8_t k = 0; k < MAX_DRIVES; ++k) drive_[k] = 0;
  pump_ = false;
  mode_ = mode;
}

Outputs Core::outputs() const {
  Outputs pins = {mode_ == ARMED && (pump_ || !board_->pump), {}, pump_, grip_};
  for (uint8_t k = 0; k < MAX_DRIVES; ++k) pins.drive[k] = drive_[k];
  return pins;
}

const char *Core::announcement() {
  writer_.start(short_, sizeof short_, 0);
  writer_.put(" boot ");
  writer_.put(cause_);
  writer_.put(' ');
  writer_.put_unsigned(boot_);
  writer_.put(' ');
  write_version();
  return said_ = writer_.finish();
}

void Core::write_version() {
  writer_.put(VERSION);
  writer_.put('+');
  writer_.put_unsigned(serial_);
}

void Core::write_identity() {
  writer_.put(" ok thermogrip/1 ");
  write_version();
  writer_.put(' ');
  for (uint8_t k = 0; k < board_->n_drives; ++k) {
    const Channel &channel = board_->drives[k];
    if (k > 0) writer_.put(',');
    writer_.put(channel.name);
    writer_.put(':');
    writer_.put(channel.unit);
    writer_.put(':');
    writer_.put_number(channel.low);
    writer_.put(':');
    writer_.put_number(channel.high);
  }
  writer_.put(board_->pump ? " pump " : " - ");
  for (uint8_t k = 0; k < board_->n_sensors; ++k) {
    if (k > 0) writer_.put(',');
    writer_.put(board_->sensors[k].name);
  }
}

void Core::write_state(uint32_t now_ms) {
  writer_.put(" ok ");
  writer_.put(MODES[mode_]);
  writer_.put(' ');
  writer_.put_unsigned(now_ms - started_ms_);
  writer_.put(' ');
  writer_.put(cause_);
  writer_.put(' ');
  writer_.put_unsigned(boot_);
  writer_.put(' ');
  write_faults();
  writer_.put(pump_ ? " 1 " : " 0 ");
  writer_.put(grip_ ? "1 " : "0 ");
  for (uint8_t k = 0; k < board_->n_drives; ++k) {
    if (k > 0) writer_.put(',');
    writer_.put_number(drive_[k]);
  }
  writer_.put(' ');
  for (uint8_t k = 0; k < board_->n_sensors; ++k) {
    if (k > 0) writer_.put(',');
    write_temperature(values_[k]);
  }
}

void Core::write_temperature(int32_t value) {
  if (value == OPEN) {
    writer_.put("open");
  } else if (value == SHORTED) {
    writer_.put("short");
  } else {
    writer_.put_number(value);
  }
}

void Core::write_faults() {
  if (n_latched_ == 0) writer_.put('-');
  for (uint8_t k = 0; k < n_latched_; ++k) {
    if (k > 0) writer_.put(',');
    if (latches_[k] == MAX_SENSORS) {
      writer_.put("pump");
    } else {
      writer_.put(KINDS[bad_counts_[latches_[k]].latched]);
      writer_.put(':');
      writer_.put(board_->sensors[latches_[k]].name);
    }
  }
}

int32_t thermistor(uint16_t sum, uint8_t n, float fixed_ohm, float r25_ohm, float beta_K, bool thermistor_low) {
  const uint16_t END = 8, TOP = 1023;  // counts from the converter's ends: beyond, the wire is broken or shorted
  bool at_top = sum > n * (TOP - END), at_bottom = sum < n * END;
  if (at_top || at_bottom) return at_top == thermistor_low ? OPEN : SHORTED;
  float share = static_cast<float>(sum) / static_cast<float>(n * TOP);
  float ohm = thermistor_low ? fixed_ohm * share / (1 - share) : fixed_ohm * (1 - share) / share;
  float kelvin = 1 / (1 / 298.15f + logf(ohm / r25_ohm) / beta_K);
  return static_cast<int32_t>(lroundf(1000 * (kelvin - 273.15f)));
}

}  // namespace thermogrip
