#include "line.h"

#include <string.h>

namespace thermogrip {

namespace {

int hex(char c) {
  if (c >= '0' && c <= '9') return c - '0';
  return c >= 'A' && c <= 'F' ? c - 'A' + 10 : -1;
}

// The two sums of a line, forwards in the upper half.
uint32_t both_sums(const char *data, size_t n) {
  return static_cast<uint32_t>(crc16(data, n, false)) << 16 | crc16(data, n, true);
}

}  // namespace

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

// A byte at a time, without a table: what a bitwise loop takes, 7 ms a line, is too long beside 100 Hz.
uint16_t crc16(const char *data, size_t n, bool backwards) {
  uint16_t crc = 0xFFFF;
  for (size_t k = 0; k < n; ++k) {
    uint8_t byte = static_cast<uint8_t>(data[backwards ? n - 1 - k : k]);
    uint8_t top = static_cast<uint8_t>(crc >> 8 ^ byte);
    top = static_cast<uint8_t>(top ^ top >> 4);
    uint16_t wide = top;
    crc = static_cast<uint16_t>(crc << 8 ^ wide << 12 ^ wide << 5 ^ wide);
  }
  return crc;
}

const char *check_line(const char *data, size_t n) {
  if (n > MAX_BODY + CHECK) return "overlong";
  if (n < CHECK) return "check";
  const char *trailer = data + n - CHECK;
  if (trailer[0] != '*') return "check";
  uint32_t length = 0, sums = 0;
  for (uint8_t k = 1; k < CHECK; ++k) {
    int digit = hex(trailer[k]);
    if (digit < 0) return "check";
    uint32_t &number = k < 3 ? length : sums;
    number = 16 * number + static_cast<uint32_t>(digit);
  }
  if (length != n - CHECK) return "length";
  if (sums != both_sums(data, n - 8)) return "crc";
  bool space = true;  // a word must begin
  for (size_t k = 0; k < n - CHECK; ++k) {
    if (data[k] < ' ' || data[k] > '~' || data[k] == '*' || (space && data[k] == ' ')) return "grammar";
    space = data[k] == ' ';
  }
  return space ? "grammar" : nullptr;
}

void LineWriter::start(char *line, size_t size, uint32_t seq) {
  line_ = line;
  room_ = size - (CHECK + ENDS);
  length_ = 0;
  put_unsigned(seq);
}

void LineWriter::put(char c) {
  if (length_ < room_ && length_ < MAX_BODY) line_[length_++] = c;
}

void LineWriter::put(const char *text) {
  while (*text != '\0') put(*text++);
}

void LineWriter::put_unsigned(uint32_t value) {
  char digits[10];
  uint8_t n = 0;
  for (; value > 0xFFFF; value /= 10) digits[n++] = static_cast<char>('0' + value % 10);
  uint16_t rest = static_cast<uint16_t>(value);  // divided three times as fast; a line has a hundred digits
  do {
    digits[n++] = static_cast<char>('0' + rest % 10);
    rest = static_cast<uint16_t>(rest / 10);
  } while (rest > 0);
  while (n > 0) put(digits[--n]);
}

void LineWriter::put_number(int32_t value) {
  if (value < 0) put('-');
  put_unsigned(value < 0 ? 0u - static_cast<uint32_t>(value) : static_cast<uint32_t>(value));
}

const char *LineWriter::finish() {
  static const char HEX[] = "0123456789ABCDEF";
  size_t n = length_;
  line_[length_++] = '*';
  line_[length_++] = HEX[n / 16 % 16];
  line_[length_++] = HEX[n % 16];
  uint32_t sums = both_sums(line_, length_);
  for (int shift = 28; shift >= 0; shift -= 4) line_[length_++] = HEX[(sums >> shift) % 16];
  line_[length_++] = '\n';
  line_[length_] = '\0';
  return line_;
}

}  // namespace thermogrip
