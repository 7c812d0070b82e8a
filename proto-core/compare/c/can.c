/* The benchmark's CAN frames, decoded by the functions that cantools writes for a database.
 *
 *     can FRAMES COUNT
 *
 * FRAMES is a file of frames of 12 bytes: the id, little-endian, and eight bytes of data. All are decoded COUNT times. frames.h
 * is of cantools; ids.h has a line FRAME(ID) for each of its messages. */

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "frames.h"

struct frame {
    uint32_t id;
    uint8_t data[8];
};

#define FRAME(ID) struct frames_frame##ID##_t frame##ID;
static struct {
#include "ids.h"
} values;
#undef FRAME

#define MOST 65536
static struct frame frames[MOST];

/* What a user writes around them: which function it is, by the id. */
static int decode(const struct frame *received)
{
    switch (received->id) {
#define FRAME(ID) \
    case ID: return frames_frame##ID##_unpack(&values.frame##ID, received->data, sizeof received->data);
#include "ids.h"
#undef FRAME
    default: return -1;
    }
}

int main(int argc, char **argv)
{
    if (argc != 3) {
        fprintf(stderr, "usage: can FRAMES COUNT\n");
        return 2;
    }
    FILE *file = fopen(argv[1], "rb");
    if (!file) {
        perror(argv[1]);
        return 1;
    }
    size_t count = fread(frames, sizeof frames[0], MOST, file);
    fclose(file);
    for (unsigned long pass = strtoul(argv[2], NULL, 10); pass > 0; pass--) {
        size_t decoded = 0;
        for (size_t at = 0; at < count; at++)
            decoded += decode(&frames[at]) == 0;
        if (decoded != count || count == 0) {
            fprintf(stderr, "%zu of %zu frames were decoded\n", decoded, count);
            return 1;
        }
    }
    /* The newest values, of the newest frame's two signals. */
    const struct frame *newest = &frames[count - 1];
    float pair[2] = { 0, 0 };
#define FRAME(ID) \
    if (newest->id == ID) { pair[0] = values.frame##ID.first##ID; pair[1] = values.frame##ID.second##ID; }
#include "ids.h"
#undef FRAME
    if (memcmp(pair, newest->data, sizeof pair) != 0) {
        fprintf(stderr, "the newest frame has other values\n");
        return 1;
    }
    return 0;
}
