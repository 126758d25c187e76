/* @ABOUT@ */
#ifndef HNO_CONTROLLER_H
#define HNO_CONTROLLER_H

#define HNO_PLAYERS @PLAYERS@
#define HNO_STATES @STATES@   /* of each player */
#define HNO_CONTROLS @CONTROLS@ /* of each player */
#define HNO_FUNCTIONS @FUNCTIONS@ /* value functions: one for each player, or one potential of all */
#define HNO_HORIZON @HORIZON@ /* s */
#define HNO_IDENTITY @IDENTITY@u /* of this controller */
#define HNO_FINGERPRINT "@FINGERPRINT@" /* of the game and its constants, as in manifest.json */

/* Return codes. Below 0 nothing was written; otherwise bits that warn. */
#define HNO_OK 0
#define HNO_WARNING_STATE 1       /* x lies outside the PDE box, where nothing was learned */
#define HNO_WARNING_TYPE 2        /* theta lies outside the type box */
#define HNO_ERROR_NULL (-1)       /* a pointer is missing */
#define HNO_ERROR_NOT_FINITE (-2) /* an entry that is given, or would be answered, is NaN or infinite */
#define HNO_ERROR_TAU (-3)        /* the time to go is not within the horizon */
#define HNO_ERROR_PREPARED (-4)   /* not filled by this controller's hno_prepare */
#define HNO_ERROR_SIZE (-5)       /* a number of types below 0 */

/* What follows from the types; the caller owns it. Copies are as good. */
typedef struct {
    unsigned identity;
    int warnings;
@PREPARED@
} hno_prepared;

/* Everything that is known of one state. */
typedef struct {
@ANSWER@
} hno_answer;

#ifdef __cplusplus
extern "C" {
#endif

/* theta[HNO_PLAYERS]: one type for each player. */
int hno_prepare(const float *theta, hno_prepared *prepared);

/* tau: time to go, s. x[HNO_PLAYERS * HNO_STATES]: the players' states, one after the other. u[HNO_PLAYERS * HNO_CONTROLS].
   Units are the game's. */
int hno_control(const hno_prepared *prepared, float tau, const float *x, float *u);

/* value[HNO_PLAYERS]: what each player gains until the end. */
int hno_value(const hno_prepared *prepared, float tau, const float *x, float *value);

/* costate[HNO_FUNCTIONS * HNO_PLAYERS * HNO_STATES]: derivatives of the value functions in the states. */
int hno_costate(const hno_prepared *prepared, float tau, const float *x, float *costate);

int hno_everything(const hno_prepared *prepared, float tau, const float *x, hno_answer *answer);

/* One state and `count` types, which share what does not depend on them. Arrays hold one block a type, as above, and may
   be null where they are not wanted. */
int hno_many_types(const hno_prepared *prepared, int count, float tau, const float *x, float *value, float *costate,
                   float *u);

#ifdef __cplusplus
}
#endif
#endif
