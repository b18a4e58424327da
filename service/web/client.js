import{a,b}from"./chunk-PAUOIMV7.js";import"./chunk-I7AUKTXE.js";export{b as Client,a as ServiceError};
