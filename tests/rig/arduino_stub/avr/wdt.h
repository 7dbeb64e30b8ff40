#pragma once
enum { WDTO_1S = 6 };
void wdt_disable();
void wdt_enable(uint8_t timeout);
void wdt_reset();
