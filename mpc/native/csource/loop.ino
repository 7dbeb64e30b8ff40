// A control loop: fill in the three functions, choose targets, upload.
#include <tg_design.h>

static tg_controller controller;
static double y[TG_NY], d[TG_SOME(TG_ND)], target[TG_NC];
static bool begun = false;

// A reading of output i [degC]. NAN means lost: until your sensor is read here, the drives stay at rest.
static double read_output(int i) { (void)i; return NAN; }

// What disturbance i measures, the room's temperature say [degC]; NAN where nobody does.
static double read_disturbance(int i) { return tg_the_design.usual_d[i]; }

// Apply drive j, a number in its range; the pump runs where pump is 1.
static void write_drive(int j, double value, int pump) { (void)j; (void)value; (void)pump; }

void setup()
{
    Serial.begin(115200);
    for (int r = 0; r < tg_the_design.n_c; r++)
        target[r] = 30.0;
}

void loop()
{
    for (int i = 0; i < TG_NY; i++)
        y[i] = read_output(i);
    for (int i = 0; i < TG_ND; i++)
        d[i] = read_disturbance(i);
    if (!begun)
        tg_reset(&controller, &tg_the_design, y, d);
    begun = true;
    tg_move move = tg_step(&controller, 1e-3 * (double)millis(), y, d, NULL, target);
    for (int j = 0; j < TG_NU; j++)
        write_drive(j, move.drive[j], move.pump);
    Serial.print(tg_status_text(move.status));
    Serial.print(" ");
    Serial.println(tg_advice_text(move.advice));
    delay((unsigned long)(250.0 * tg_the_design.dt));  // called more often than it moves, it holds its move
}
