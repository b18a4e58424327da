import{a,b}from"./chunk-3LFGW7CZ.js";import"./chunk-I7AUKTXE.js";export{b as Client,a as ServiceError};
