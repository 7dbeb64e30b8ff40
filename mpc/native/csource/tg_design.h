/* The numbers of this controller. */
#ifndef TG_DESIGN_H
#define TG_DESIGN_H

#include "tg_controller.h"

#ifdef __cplusplus
extern "C" {
#endif

extern const tg_design tg_the_design;

#ifdef __cplusplus
}
#endif

#endif
