// Just enough of Arduino for a compiler to read the sketch on a PC; nothing of it runs.
#pragma once
#include <stdint.h>
#include <stdlib.h>
enum { LOW, HIGH, OUTPUT, INPUT_PULLUP, FALLING };
const uint8_t A0 = 14, A1 = 15, A2 = 16;
extern uint8_t MCUSR;
const uint8_t PORF = 0, EXTRF = 1, BORF = 2, WDRF = 3;
#define _BV(bit) (1 << (bit))
void digitalWrite(uint8_t pin, uint8_t value);
void analogWrite(uint8_t pin, int value);
int analogRead(uint8_t pin);
unsigned long micros();
void pinMode(uint8_t pin, uint8_t mode);
uint32_t millis();
void noInterrupts();
void interrupts();
int digitalPinToInterrupt(uint8_t pin);
void attachInterrupt(int number, void (*call)(), int mode);
struct SerialPort {
  int availableForWrite();
  void write(char byte);
  void begin(long baud);
  int available();
  int read();
  void print(const char *text);
};
extern SerialPort Serial;
void setup();
void loop();
