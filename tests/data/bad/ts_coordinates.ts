GOCAD TSurf 1
HEADER {
name: bad one
}
TFACE
VRTX 1 0 0
END
