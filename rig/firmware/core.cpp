#include "core.h"

#include <math.h>
#include <string.h>

namespace thermogrip {

namespace {

const char *const MODES[] = {"off", "armed", "expired", "latched"};
const char *const KINDS[] = {"", "over", "under", "open", "short"};

bool same(const char *a, const char *b) { return strcmp(a, b) == 0; }

// One spelling of an integer: 0, or digits that do not begin with 0, perhaps after a minus.
bool integer(const char *text, int64_t *value) {
  bool minus = text[0] == '-';
  const char *digits = text + (minus ? 1 : 0);
  size_t n = strlen(digits);
  if (n == 0 || n > 10 || (digits[0] == '0' && (n > 1 || minus))) return false;
  int64_t sum = 0;
  for (size_t k = 0; k < n; ++k) {
    if (digits[k] < '0' || digits[k] > '9') return false;
    sum = 10 * sum + (digits[k] - '0');
  }
  *value = minus ? -sum : sum;
  return *value >= INT32_MIN && *value <= static_cast<int64_t>(UINT32_MAX);
}

int hex(char c) {
  if (c >= '0' && c <= '9') return c - '0';
  return c >= 'A' && c <= 'F' ? c - 'A' + 10 : -1;
}

// The two sums of a line, forwards in the upper half.
uint32_t both_sums(const char *data, size_t n) {
  return static_cast<uint32_t>(crc16(data, n, false)) << 16 | crc16(data, n, true);
}

}  // namespace

uint16_t crc16(const char *data, size_t n, bool backwards) {
  uint16_t crc = 0xFFFF;
  for (size_t k = 0; k < n; ++k) {
    uint8_t byte = static_cast<uint8_t>(data[backwards ? n - 1 - k : k]);
    crc = static_cast<uint16_t>(crc ^ (static_cast<uint16_t>(byte) << 8));
    for (uint8_t bit = 0; bit < 8; ++bit) {
      crc = static_cast<uint16_t>((crc & 0x8000u) ? (crc << 1) ^ 0x1021u : crc << 1);
    }
  }
  return crc;
}

void Core::begin(const Board &board, const char *cause, uint16_t boot, uint32_t now_ms) {
  board_ = board;
  cause_ = cause;
  boot_ = boot;
  started_ms_ = now_ms;
  expires_ms_ = flow_ms_ = now_ms;
  mode_ = OFF;
  pump_ = grip_ = greeted_ = pump_latched_ = have_last_ = false;
  n_latched_ = 0;
  n_in_ = n_out_ = 0;
  last_ = 0;
  answer_[0] = kept_[0] = '\0';
  for (uint8_t k = 0; k < MAX_DRIVES; ++k) drive_[k] = 0;
  for (uint8_t k = 0; k < MAX_SENSORS; ++k) {
    values_[k] = OPEN;
    watches_[k] = {GOOD, 0, GOOD};
  }
}

void Core::receive(char byte, uint32_t now_ms) {
  expire(now_ms);
  answer_[0] = '\0';
  if (byte != '\n') {
    // one more than the longest line is kept, which shows that it is too long
    if (n_in_ < MAX_BODY + CHECK + 1) in_[n_in_++] = byte;
    return;
  }
  if (n_in_ > 0) line(now_ms);
  n_in_ = 0;
}

// Return what is wrong with the n bytes received, nothing where they are a line.
const char *Core::check(size_t n) const {
  if (n > MAX_BODY + CHECK) return "overlong";
  if (n < CHECK) return "check";
  const char *trailer = in_ + n - CHECK;
  if (trailer[0] != '*') return "check";
  uint32_t length = 0, sums = 0;
  for (uint8_t k = 1; k < CHECK; ++k) {
    int digit = hex(trailer[k]);
    if (digit < 0) return "check";
    uint32_t &number = k < 3 ? length : sums;
    number = 16 * number + static_cast<uint32_t>(digit);
  }
  if (length != n - CHECK) return "length";
  if (sums != both_sums(in_, n - 8)) return "crc";
  bool space = true;  // a word must begin
  for (size_t k = 0; k < n - CHECK; ++k) {
    if (in_[k] < ' ' || in_[k] > '~' || in_[k] == '*' || (space && in_[k] == ' ')) return "grammar";
    space = in_[k] == ' ';
  }
  return space ? "grammar" : nullptr;
}

void Core::line(uint32_t now_ms) {
  char *words[8];
  size_t n = 0, body = n_in_ < CHECK ? 0 : n_in_ - CHECK;
  bool good = check(n_in_) == nullptr;
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
    start(0);
    put(" err corrupt");
    finish();
    return;
  }
  // what a device says comes back where a line echoes: answering it would never end
  if (same(words[1], "ok") || same(words[1], "err") || same(words[1], "boot")) return;
  bool bare_hello = n == 2 && same(words[1], "hello");
  if (have_last_ && last_ == static_cast<uint32_t>(seq) && !bare_hello) {
    strcpy(answer_, kept_);
    return;
  }
  bool hello = false;
  const char *refusal = obey(words + 1, n - 1, &hello, now_ms);
  start(static_cast<uint32_t>(seq));
  if (refusal != nullptr) {
    put(" err ");
    put(refusal);
  } else if (hello) {
    write_identity();
  } else {
    write_state(now_ms);
  }
  finish();
  have_last_ = true;
  last_ = static_cast<uint32_t>(seq);
  strcpy(kept_, answer_);
}

// Do what is asked; return the code of a refusal, or nothing.
const char *Core::obey(char **words, size_t n, bool *hello, uint32_t now_ms) {
  const char *word = words[0];
  if (same(word, "drive")) return set_drive(words, n, now_ms);
  if (same(word, "grip")) {
    if (n != 2 || !(same(words[1], "0") || same(words[1], "1"))) return "syntax";
    grip_ = words[1][0] == '1';
    return nullptr;
  }
  bool known = same(word, "hello") || same(word, "read") || same(word, "off") || same(word, "clear");
  if (!known) return "unknown";
  if (n != 1) return "syntax";
  if (same(word, "hello")) {
    *hello = greeted_ = true;
    switch_off(latched() ? LATCHED : OFF);
  } else if (same(word, "off")) {
    switch_off(latched() ? LATCHED : OFF);
  } else if (same(word, "clear")) {
    for (uint8_t k = 0; k < board_.n_sensors; ++k) {
      if (watches_[k].kind != GOOD) return "active";
    }
    n_latched_ = 0;
    pump_latched_ = false;
    for (uint8_t k = 0; k < board_.n_sensors; ++k) watches_[k].latched = GOOD;
    switch_off(OFF);
  }
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
  if (count != board_.n_drives) return "syntax";
  for (uint8_t k = 0; k < board_.n_drives; ++k) {
    inside = inside && drive[k] >= board_.drives[k].low && drive[k] <= board_.drives[k].high;
    any = any || drive[k] != 0;
  }
  if (!inside) return "range";
  if (board_.pump && !pump && any) return "interlock";
  for (uint8_t k = 0; k < board_.n_drives; ++k) drive_[k] = static_cast<int32_t>(drive[k]);
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
  for (uint8_t k = 0; k < board_.n_sensors; ++k) {
    values_[k] = values[k];
    Watch &watch = watches_[k];
    Kind kind = kind_of(board_.sensors[k], values[k]);
    bool again = kind != GOOD && kind == watch.kind;
    watch.count = static_cast<uint8_t>(again ? (watch.count < BAD_SAMPLES ? watch.count + 1 : watch.count)
                                             : kind != GOOD);
    watch.kind = kind;
    if (watch.count >= BAD_SAMPLES && watch.latched == GOOD) {
      watch.latched = kind;
      latch(k);
    }
  }
  bool driven = false;
  for (uint8_t k = 0; k < board_.n_drives; ++k) driven = driven || drive_[k] != 0;
  if (flow || !driven || !pump_) flow_ms_ = now_ms;
  bool stalled = board_.tachometer && board_.pump && now_ms - flow_ms_ >= PUMP_STALL_MS;
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
  Outputs pins = {mode_ == ARMED && (pump_ || !board_.pump), {}, pump_, grip_};
  for (uint8_t k = 0; k < MAX_DRIVES; ++k) pins.drive[k] = drive_[k];
  return pins;
}

const char *Core::announcement() {
  start(0);
  put(" boot ");
  put(cause_);
  put(' ');
  put_unsigned(boot_);
  put(' ');
  put(VERSION);
  finish();
  return answer_;
}

void Core::write_identity() {
  put(" ok thermogrip/1 ");
  put(VERSION);
  put(' ');
  for (uint8_t k = 0; k < board_.n_drives; ++k) {
    const Channel &channel = board_.drives[k];
    if (k > 0) put(',');
    put(channel.name);
    put(':');
    put(channel.unit);
    put(':');
    put_number(channel.low);
    put(':');
    put_number(channel.high);
  }
  put(board_.pump ? " pump " : " - ");
  for (uint8_t k = 0; k < board_.n_sensors; ++k) {
    if (k > 0) put(',');
    put(board_.sensors[k].name);
  }
}

void Core::write_state(uint32_t now_ms) {
  put(" ok ");
  put(MODES[mode_]);
  put(' ');
  put_unsigned(now_ms - started_ms_);
  put(' ');
  put(cause_);
  put(' ');
  put_unsigned(boot_);
  put(' ');
  write_faults();
  put(pump_ ? " 1 " : " 0 ");
  put(grip_ ? "1 " : "0 ");
  for (uint8_t k = 0; k < board_.n_drives; ++k) {
    if (k > 0) put(',');
    put_number(drive_[k]);
  }
  put(' ');
  for (uint8_t k = 0; k < board_.n_sensors; ++k) {
    if (k > 0) put(',');
    if (values_[k] == OPEN) {
      put("open");
    } else if (values_[k] == SHORTED) {
      put("short");
    } else {
      put_number(values_[k]);
    }
  }
}

void Core::write_faults() {
  if (n_latched_ == 0) put('-');
  for (uint8_t k = 0; k < n_latched_; ++k) {
    if (k > 0) put(',');
    if (latches_[k] == MAX_SENSORS) {
      put("pump");
    } else {
      put(KINDS[watches_[latches_[k]].latched]);
      put(':');
      put(board_.sensors[latches_[k]].name);
    }
  }
}

void Core::start(uint32_t seq) {
  n_out_ = 0;
  put_unsigned(seq);
}

void Core::put(char c) {
  if (n_out_ < MAX_BODY) answer_[n_out_++] = c;
}

void Core::put(const char *text) {
  while (*text != '\0') put(*text++);
}

void Core::put_unsigned(uint32_t value) {
  char digits[10];
  uint8_t n = 0;
  do {
    digits[n++] = static_cast<char>('0' + value % 10);
    value /= 10;
  } while (value > 0);
  while (n > 0) put(digits[--n]);
}

void Core::put_number(int32_t value) {
  if (value < 0) put('-');
  put_unsigned(value < 0 ? 0u - static_cast<uint32_t>(value) : static_cast<uint32_t>(value));
}

// Close the line: star, length, both CRCs, end.
void Core::finish() {
  static const char HEX[] = "0123456789ABCDEF";
  size_t n = n_out_;
  answer_[n_out_++] = '*';
  answer_[n_out_++] = HEX[n / 16 % 16];
  answer_[n_out_++] = HEX[n % 16];
  uint32_t sums = both_sums(answer_, n_out_);
  for (int shift = 28; shift >= 0; shift -= 4) answer_[n_out_++] = HEX[(sums >> shift) % 16];
  answer_[n_out_++] = '\n';
  answer_[n_out_] = '\0';
}

int32_t thermistor(uint16_t counts, float fixed_ohm, float r25_ohm, float beta_K, bool thermistor_low) {
  const uint16_t END = 8;  // counts from the converter's ends: beyond, the wire is broken or shorted
  bool at_top = counts > 1023 - END, at_bottom = counts < END;
  if (at_top || at_bottom) return at_top == thermistor_low ? OPEN : SHORTED;
  float share = static_cast<float>(counts) / 1023.0f;
  float ohm = thermistor_low ? fixed_ohm * share / (1 - share) : fixed_ohm * (1 - share) / share;
  float kelvin = 1 / (1 / 298.15f + logf(ohm / r25_ohm) / beta_K);
  return static_cast<int32_t>(lroundf(1000 * (kelvin - 273.15f)));
}

}  // namespace thermogrip
