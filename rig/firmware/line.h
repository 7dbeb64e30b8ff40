// Lines: their check, their numbers, and how one is written; rig/serial/framing.py does the same in Python.

#ifndef THERMOGRIP_LINE_H
#define THERMOGRIP_LINE_H

#include <stddef.h>
#include <stdint.h>

namespace thermogrip {

const size_t MAX_BODY = 160;      // bytes of a line before its star
const size_t CHECK = 11;          // bytes of *LLCCCCRRRR
const size_t ENDS = 2;            // bytes of the end of line and the end of the string
const size_t MAX_LINE = MAX_BODY + CHECK + ENDS;

// CRC-16 of n bytes: polynomial 0x1021, start 0xFFFF.
uint16_t crc16(const char *data, size_t n, bool backwards);

// Return what is wrong with the n bytes received, nothing where they are a line.
const char *check_line(const char *data, size_t n);

// One spelling of an integer: 0, or digits that do not begin with 0, perhaps after a minus.
bool integer(const char *text, int64_t *value);

// Writes one line at a time into a buffer that it is given.
class LineWriter {
 public:
  // Begin a line in a buffer of so many bytes.
  void start(char *line, size_t size, uint32_t seq);

  void put(const char *text);
  void put(char c);
  void put_number(int32_t value);
  void put_unsigned(uint32_t value);

  // What does not fit is left out.
  // Close the line (star, length, both CRCs, end) and return it.
  const char *finish();

 private:
  char *line_;
  size_t length_, room_;
};

}  // namespace thermogrip

#endif
