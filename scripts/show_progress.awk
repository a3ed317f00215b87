# Counts the packages that pip collects and names the phase that follows, on one line that is rewritten.
/^ *(Collecting|Obtaining)/ { printf "\r  %d packages found ...", ++n; fflush() }
/^Installing collected packages/ { printf "\r  %d packages downloaded; writing them ...\n", n; fflush() }
